"""Processes between fishd and its clients: each owns one ZeroMQ socket.

A client may flood its socket, never read, or subscribe to a hundred thousand topics. All of that
happens in a gateway, which has its own limits and is restarted when it exceeds one. fishd shares no
memory, thread or file descriptor with it, only a short queue in the kernel.
"""

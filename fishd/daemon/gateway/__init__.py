"""The processes between fishd and everybody else: each owns one ZeroMQ socket.

A client may flood its socket, never read, or subscribe to a hundred thousand topics. All of that
happens in a gateway, which has limits of its own and is started again when it has reached one.
fishd shares no memory, thread or file descriptor with it, only a short queue in the kernel.
"""

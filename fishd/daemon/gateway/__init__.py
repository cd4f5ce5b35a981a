"""Process between fishd and its clients: it owns the ZeroMQ sockets of requests and telemetry.

A client may flood a socket, never read, or subscribe to a hundred thousand topics. All of that
happens in the gateway, which has its own limits and is replaced when it exceeds one. fishd shares
no memory, thread or file descriptor with it, only a short queue in the kernel.
"""

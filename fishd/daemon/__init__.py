"""The process `fishd`: the loop in real time, its sockets, its requests, and systemd."""

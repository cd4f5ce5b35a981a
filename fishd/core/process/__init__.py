"""Plumbing of a process: its log, end, lock, priority, sockets, and systemd."""

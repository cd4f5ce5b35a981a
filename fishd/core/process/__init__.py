"""Infrastructure of a process: logs, shutdown, locks, priority, sockets, and systemd."""

"""Shared modules of the tools."""

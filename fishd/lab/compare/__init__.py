"""Contestants against one another: scores, tables and figures."""

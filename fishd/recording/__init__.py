"""Recordings of a fish: MCAP files, written, read, exported and replayed (extra: record)."""

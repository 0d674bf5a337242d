"""A session's log as tables in files."""

"""The window of ``cortado view``: a server, its guard, and what it shows."""

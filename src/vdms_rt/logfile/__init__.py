"""One MCAP of ours: written so that it survives, read however it ended, and repaired."""

"""What may be asked of a running daemon, over zenoh queryables: `server` and `desk` in the daemon,
`client` for programs that ask."""

"""What is said on the network and in the log: one table of topics, one schema, encoded once."""

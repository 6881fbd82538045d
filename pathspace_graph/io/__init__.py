"""What is on disk: logs, maps, results, and the files that hold them."""

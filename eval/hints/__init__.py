"""The measurement of hints: how many spoiled logs are told, and how many good ones are accused."""

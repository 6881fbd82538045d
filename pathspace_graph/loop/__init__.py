"""What happens when the loop of the track closes, and afterwards."""

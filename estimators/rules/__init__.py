"""Rules that choose the next input from what was measured, and the loop that runs them."""

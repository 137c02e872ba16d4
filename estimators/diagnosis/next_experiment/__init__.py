"""What to measure next: the input that tells rival models apart, and how surely it will."""

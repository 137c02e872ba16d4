"""Commands about a plant."""

"""Other questions than the best input of one plant at one power: several plants, least power, closed loop."""

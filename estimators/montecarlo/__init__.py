"""Monte-Carlo campaigns of the iterations: the compiled engine, its noise, and checks of information additivity."""

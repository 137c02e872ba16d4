"""The effects with CasADi's symbols: the terms that the recursions are held to, and whole models as functions of one step."""

"""Tables of a comparison: from the rows of a campaign to figures with their errors."""

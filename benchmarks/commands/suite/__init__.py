"""Commands about the suite itself: the comparison, its report, what is reproduced, how fast."""

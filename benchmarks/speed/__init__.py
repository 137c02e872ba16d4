"""Speed benchmarks: ours and a baseline in turn, same work, medians."""

"""Monte-Carlo campaigns: settings, runs, parts, stores, workers."""

"""A benchmark that other people's programs can be scored on: files, a scorer, and the first rows of its table."""

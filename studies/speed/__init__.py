"""Speed beside others who do the same work in the same run: `make bench`, docs/benchmarks.md."""

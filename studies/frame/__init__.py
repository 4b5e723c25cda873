"""What every study stands on: options, command, process pool, kept results, tables, figures, targets, averages."""

"""What the studies of feature layers share: matching to the truth, averages over seeds, targets, kept results."""

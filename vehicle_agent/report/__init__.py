"""What leaves the vehicle: decided tiles and features become reports, packed in two halves."""

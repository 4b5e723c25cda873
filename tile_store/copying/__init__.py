"""Copying a store into another database while it is in use."""

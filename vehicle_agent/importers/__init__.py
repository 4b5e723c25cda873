"""Readers of recordings (KITTI, RADIATE, PCD folders) and what turns them into drives."""

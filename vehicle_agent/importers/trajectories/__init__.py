"""Trajectories of others: files and topics with poses or positions, in their own frames, laid into a map frame.

`pose_file.read_poses` reads a file of any known kind, `frames.in_map` lays it into a frame of ours.
"""

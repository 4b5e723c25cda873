"""Trajectories of others: files and topics with poses or positions, in their own frames, laid into a map frame.

`read_poses` reads a file of any known kind, `in_map` lays it into a frame of ours.
"""

from gnd.vehicle_agent.importers.trajectories.frames import in_map as in_map
from gnd.vehicle_agent.importers.trajectories.pose_file import read_poses as read_poses
from gnd.vehicle_agent.importers.trajectories.pose_table import PoseTable as PoseTable

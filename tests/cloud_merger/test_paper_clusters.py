"""`--mode paper` clusters by scikit-learn, which no other mode loads."""

import subprocess
import sys
from pathlib import Path

PROGRAM = """
import sys
import numpy as np
from gnd.cloud_merger.merge import plain_clusters
from gnd.cloud_merger.parameters import MergeParameters
from gnd.cloud_merger.statements import STATEMENT, Kind

rows = np.zeros(6, STATEMENT)
rows["voxel_id"], rows["kind"], rows["count"] = [1, 1, 1, 1, 7, 7], Kind.MEASURED, 40
rows["mean_m"][:, 0] = [0.0, 0.001, 0.4, 0.401, 0.1, 0.1]
rows["cov_m2"] = (0.0004, 0.0, 0.0, 0.08, 0.0, 0.08)
default = plain_clusters(rows, MergeParameters()).tolist()
assert "sklearn" not in sys.modules
paper = plain_clusters(rows, MergeParameters(mode="paper")).tolist()
assert "sklearn" in sys.modules
print(default, paper)
"""


def test_paper_mode_clusters_by_the_library_and_no_other_loads_it() -> None:
    source = Path(__file__).resolve().parents[2] / "src"
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, env={"PYTHONPATH": str(source)}
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == "[0, 0, 1, 1, 2, 2] [0, 0, 1, 1, 2, 2]\n"

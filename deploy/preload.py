"""What the fork server holds ready: imported once, shared by every process of a run.

Importing this module loads the libraries of the vehicle and the merger and their compiled kernels. It starts no
thread and opens no Zenoh session, so forking afterwards is safe.
"""

import gc
import logging
import os

import gnd.cloud_merger.merger
import gnd.deploy.roles
import gnd.tile_store.server
import gnd.vehicle_agent.agent
import gnd.vehicle_agent.features.layers
from gnd.cloud_merger.warm import warm_up as warm_up_cloud
from gnd.deploy.compiling import tell_watcher
from gnd.vehicle_agent.warm import warm_up

__all__ = ["gnd"]


def _compile_in_a_child() -> None:
    """Compile what the disk's cache lacks in a process that ends: a compiler's memory would be copied to all others."""
    child = os.fork()
    if child:
        os.waitpid(child, 0)
        return
    try:
        tell_watcher()
        warm_up()
        warm_up_cloud()  # for its workers, processes of their own: they shall not compile while vehicles drive
    finally:
        os._exit(0)


try:
    _compile_in_a_child()
    warm_up()
except Exception:
    # A process that needs the kernels compiles them itself and reports its own error.
    logging.getLogger(__name__).exception("could not warm the kernels")
gc.collect()
gc.freeze()  # keeps the collector from touching, and so copying, the shared pages

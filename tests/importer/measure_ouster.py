"""How fast a capture of an Ouster is read: python tests/importer/measure_ouster.py CAPTURE FOLDER.

The one turn of CAPTURE (captures_a/OS-0-128-U1_v2.3.0_1024x10.pcap) is written 100 times into FOLDER, in pieces of 1480
bytes as a network carries them, each turn later by 0.1 s; then it is read, and all points are computed.
"""

import shutil
import struct
import sys
import time
from pathlib import Path

import numpy as np

from gnd.vehicle_agent.importer import open_recording
from gnd.vehicle_agent.importers.ouster.metadata import read_metadata
from gnd.vehicle_agent.importers.ouster.packets import packet_dtype
from gnd.vehicle_agent.importers.udp_packets import UdpCapture

TURNS, TURN_NS, PIECE = 100, 100_000_000, 1480


def written(source: Path, target: Path) -> None:
    """The capture of many turns, with its metadata."""
    metadata = read_metadata(source.with_suffix(".json"))
    layout = packet_dtype(metadata.profile, metadata.n_beams, metadata.columns_per_packet)
    turn = [one for one in UdpCapture(source).packets() if len(one.payload) == metadata.packet_bytes]
    out, number = [struct.pack("<IHHiIII", 0xA1B23C4D, 2, 4, 0, 0, 1 << 18, 1)], 0
    for k in range(TURNS):
        for one in turn:
            data = bytearray(one.payload)
            packet = np.frombuffer(data, layout)
            packet["frame_id"] = k
            packet["columns"]["t_ns"] += np.uint64(k * TURN_NS)
            udp, host_ns = struct.pack(">HHHH", 7502, 7502, 8 + len(data), 0) + data, one.host_ns + k * TURN_NS
            for at in range(0, len(udp), PIECE):
                piece, more = udp[at : at + PIECE], at + PIECE < len(udp)
                head = (0x45, 0, 20 + len(piece), number % 65_536, 0x2000 * more | at // 8, 64, 17, 0)
                frame = b"\0" * 12 + b"\x08\x00" + struct.pack(">BBHHHBBH", *head) + bytes([10, 0, 0, 1, 10, 0, 0, 2])
                frame += piece
                out.append(struct.pack("<IIII", host_ns // 10**9, host_ns % 10**9, len(frame), len(frame)) + frame)
            number += 1
    target.write_bytes(b"".join(out))
    shutil.copy(source.with_suffix(".json"), target.with_suffix(".json"))


if __name__ == "__main__":
    capture = Path(sys.argv[2]) / "many.pcap"
    written(Path(sys.argv[1]), capture)
    begin = time.monotonic()
    recording = open_recording("auto", capture)
    opened = time.monotonic()
    n = sum(len(recording.read(k)) for k in range(len(recording)))
    print(f"{len(recording)} turns, {capture.stat().st_size / 1e6:.0f} MB: sorted in {opened - begin:.2f} s")
    print(
        f"{n} points: {1000 * (time.monotonic() - opened) / len(recording):.1f} ms a turn", *recording.notes, sep="\n"
    )

"""Aravis's fake GigE Vision camera, and a proxy that loses, alters and blocks its packets.

The camera process listens at 127.0.0.1, the proxy at 127.0.0.2.
"""

from __future__ import annotations

import os
import selectors
import signal
import socket
import struct
import subprocess
import threading
import time
from contextlib import suppress
from typing import Final, Self

from support.patience import HANG_S, udp_socket

FAKE_CAMERA: Final = "arv-fake-gv-camera-0.8"
SERIAL: Final = "SVWFS-TEST"
HERE: Final = "127.0.0.2"
TURN: Final = ("127.0.0.1", 3957)  # the test process that holds this port may start the camera

_GVCP: Final = ("127.0.0.1", 3956)
_DISCOVERY: Final = bytes.fromhex("4211000200000001")
_WRITES: Final = (0x0082, 0x0086)  # of a register or of memory
_REFUSED: Final = 0x8006  # GEV_STATUS_ACCESS_DENIED
_CONTROL: Final = 0x0A00  # control register; 0 releases the camera
_STREAM_PORT: Final = 0x0D00  # destination port of frames
_ACQUISITION: Final = 0x0124  # 1 starts this camera
_LEADER: Final = 1  # first packet of a frame
_LATE_S: Final = 0.6  # a command is repeated after 0.5 s
_ALL: Final = 2**24
_FIRST_EXPOSURE_S: Final = 0.05  # this camera may send a frame at once


class Peer:
    """The camera process, which can be switched off and frozen."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None

    def start(self, *options: str) -> None:
        """Switch it on and wait until it answers."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(_GVCP)
            except OSError as error:
                raise AssertionError("another GigE Vision camera runs on this machine: UDP port 3956") from error
        self._process = subprocess.Popen([FAKE_CAMERA, "-i", "lo", "-s", SERIAL, *options])  # noqa: S603 - ours
        deadline_s = time.monotonic() + HANG_S
        while not _answers():
            assert self._process.poll() is None
            assert time.monotonic() < deadline_s

    def kill(self) -> None:
        """Switch it off."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

    def ensure(self) -> None:
        """Switch it on if it is off."""
        if self._process is None:
            self.start()
        else:
            self.send(signal.SIGCONT)

    @staticmethod
    def leave_running() -> None:
        """Start the acquisition without an owner, as left by a killed program."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
            asking.settimeout(HANG_S)
            asking.sendto(struct.pack(">HHHHII", 0x4201, 0x0082, 8, 1, _ACQUISITION, 1), _GVCP)
            assert asking.recv(1024)[:4] == bytes.fromhex("00000083")

    def send(self, number: signal.Signals) -> None:
        """Freeze it or continue."""
        assert self._process is not None
        os.kill(self._process.pid, number)


def _answers() -> bool:
    """True if it acknowledges a GVCP discovery."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        asking.settimeout(0.1)
        with suppress(TimeoutError, ConnectionError):
            asking.sendto(_DISCOVERY, _GVCP)
            return asking.recv(1024)[2:4] == b"\x00\x03"
    return False


class GigeWire:
    """Proxy between driver and camera, with the faults of `camera_contract.CameraFaults`."""

    def __init__(self, peer: Peer) -> None:
        self._peer = peer
        self._poll = selectors.DefaultSelector()
        self._front = self._socket((HERE, 3956))
        self._stream = self._socket(("127.0.0.1", 0))
        self._stream.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2**22)
        self._behind: dict[tuple[str, int], socket.socket] = {}  # to the camera, by sender
        self._client: dict[socket.socket, tuple[str, int]] = {}
        self._frames_go_to = ("127.0.0.1", 0)
        self._asked: dict[tuple[tuple[str, int], int], int] = {}  # requested ports for frames, by sender and request
        self._started_s = 0.0
        self._is_over = False
        self._is_cut = False
        self._is_stalled = False
        self._frames_to_lose = 0
        self._writes_until_refusal = 0  # 0: none
        self._is_held = False  # by an owner whose release was refused
        self._passing = _ALL  # packets of the present frame
        self._will_be_cut = False
        self._garbled = 0  # number of replies to garble
        self._delay_s = 0.0  # of the next reply
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._is_over = True
        self._thread.join()
        for passing in (self._front, self._stream, *self._client):
            passing.close()
        self._poll.close()

    def unplug(self) -> None:
        """Block all packets."""
        self._is_cut = True

    def plug_in(self) -> None:
        """Pass all packets; the camera was without power."""
        self._peer.kill()
        self._peer.start()
        self._will_be_cut = self._is_cut = self._is_held = False

    def unplug_in_a_frame(self) -> None:
        """Cut the cable after two packets of the next frame."""
        self._will_be_cut = True

    def stall(self) -> None:
        """Block frames only."""
        self._is_stalled = True

    def lose_frames(self, count: int) -> None:
        """Lose that many coming frames, some wholly, some in part."""
        self._frames_to_lose = count

    def lose_two(self) -> None:
        """Lose two frames, one of them in part."""
        self.lose_frames(2)

    def refuse_next(self) -> None:
        """Answer the next write with a refusal."""
        self.refuse(1)

    def refuse(self, which: int) -> None:
        """Refuse one of the next writes; 1 is the next."""
        self._writes_until_refusal = which

    def garble_next(self) -> None:
        """Garble the next reply."""
        self._garbled = 1

    def delay_next(self) -> None:
        """Delay the next reply beyond its timeout."""
        self._delay_s = _LATE_S

    def mend(self) -> None:
        """Clear all faults; restart the camera only if the cable was cut or the camera is held."""
        self._is_stalled = False
        self._frames_to_lose = self._writes_until_refusal = self._garbled = 0
        self._delay_s = 0.0
        if self._is_held or not self.is_whole:
            self.plug_in()

    @property
    def is_whole(self) -> bool:
        """True unless the cable is cut."""
        return not (self._is_cut or self._will_be_cut)

    def _socket(self, address: tuple[str, int]) -> socket.socket:
        made = udp_socket(address)
        self._poll.register(made, selectors.EVENT_READ)
        return made

    def _run(self) -> None:
        while not self._is_over:
            for key, _ in self._poll.select(0.05):
                ready = key.fileobj
                assert isinstance(ready, socket.socket)
                with suppress(ConnectionError):  # the camera's port is closed
                    packet, sender = ready.recvfrom(65536)
                    if self._is_cut:
                        continue
                    if ready is self._front:
                        self._pass_command(packet, sender)
                    elif ready is self._stream:
                        self._pass_frame(packet)
                    else:
                        self._pass_reply(packet, self._client[ready])

    def _pass_command(self, packet: bytes, sender: tuple[str, int]) -> None:
        command, _, identifier = struct.unpack_from(">HHH", packet, 2)
        if command in _WRITES:
            register, value = struct.unpack_from(">II", packet, 8)
            self._writes_until_refusal -= 1
            if self._writes_until_refusal == 0:
                self._is_held |= (register, value) == (_CONTROL, 0)
                self._front.sendto(struct.pack(">HHHHI", _REFUSED, command + 1, 4, identifier, 0), sender)
                return
            if register == _STREAM_PORT:
                self._asked[sender, identifier] = value & 0xFFFF
                own = value & ~0xFFFF | self._stream.getsockname()[1]
                packet = packet[:12] + struct.pack(">I", own)
            elif register == _ACQUISITION and value:
                self._started_s = time.monotonic()
        if sender not in self._behind:
            self._behind[sender] = self._socket(("127.0.0.1", 0))
            self._client[self._behind[sender]] = sender
        self._behind[sender].sendto(packet, _GVCP)

    def _pass_reply(self, packet: bytes, client: tuple[str, int]) -> None:
        status, _, _, identifier = struct.unpack_from(">HHHH", packet)
        port = self._asked.pop((client, identifier), None)
        if port is not None and status == 0:
            self._frames_go_to = (client[0], port)
        if self._garbled:
            self._garbled -= 1
            packet = bytes(255 - byte for byte in packet)
        delay_s, self._delay_s = self._delay_s, 0.0
        time.sleep(delay_s)
        self._front.sendto(packet, client)

    def _pass_frame(self, packet: bytes) -> None:
        (infos,) = struct.unpack_from(">I", packet, 4)
        content, index = infos >> 24 & 0x7F, infos & 0xFFFFFF
        if self._frames_go_to[1] == 0:  # nowhere
            return
        if content == _LEADER:
            self._passing = self._packets_that_pass()
        if index >= self._passing:
            self._is_cut |= self._will_be_cut
            return
        self._stream.sendto(packet, self._frames_go_to)

    def _packets_that_pass(self) -> int:
        """Number of packets of the beginning frame to pass."""
        if self._is_stalled or time.monotonic() < self._started_s + _FIRST_EXPOSURE_S:
            return 0
        if self._will_be_cut:
            return 2
        if self._frames_to_lose:
            self._frames_to_lose -= 1
            return 2 * (self._frames_to_lose % 2)
        return _ALL

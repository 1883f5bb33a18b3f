"""Rendering ahead in a process of its own, at low priority, so that the live program never waits for it.

The images appear in the cache, one file each: that is all the two processes share. The child ends when its standard
input does, which the system closes for it however the parent ends.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import threading
from pathlib import Path

from simulated_devices.rendering import ImageCache, Renderer, Scene


class BackgroundRendering:
    """A child process that renders all states of one mask which the cache does not hold."""

    def __init__(self, scene: Scene, mask: str, cache_folder: Path) -> None:
        package_parent = str(Path(__file__).resolve().parents[1])
        search_path = os.pathsep.join(filter(None, [package_parent, os.environ.get("PYTHONPATH", "")]))
        below_normal = getattr(subprocess, "BELOW_NORMAL_PRIORITY_CLASS", 0)  # exists on Windows only
        self._process = subprocess.Popen(
            [sys.executable, "-m", "simulated_devices.background"],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            env={**os.environ, "PYTHONPATH": search_path, "OPENBLAS_NUM_THREADS": "1"},
            creationflags=below_normal,
        )
        if self._process.stdin is None:  # cannot be: a pipe was asked for
            raise RuntimeError("the background process has no standard input")
        pickle.dump((scene, mask, str(cache_folder)), self._process.stdin)
        self._process.stdin.flush()

    def close(self) -> None:
        """End the process now; whatever it had begun is forgotten."""
        self._process.kill()  # nothing to save: files appear complete or not at all
        self._process.wait()
        if self._process.stdin is not None:
            self._process.stdin.close()


def render_missing(scene: Scene, mask: str, cache_folder: Path) -> None:
    """Render, in order, every state that the cache does not hold; end early if nothing can be kept there."""
    cache, renderer = ImageCache(cache_folder, scene), Renderer(scene, threads=1)
    for state in range(scene.states):
        if cache.load(mask, state) is None and not cache.save(mask, state, renderer.state(mask, state)):
            return


def _end_with_parent() -> None:
    # Not sys.stdin.buffer.read(), whose lock, held at the interpreter's end, makes Python abort.
    while os.read(sys.stdin.fileno(), 1):  # nothing, when the parent closes the pipe or dies
        pass
    os._exit(0)


def _main() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, whose end is ours
    if hasattr(os, "nice"):
        os.nice(10)
    scene, mask, cache_folder = pickle.load(sys.stdin.buffer)  # noqa: S301 - written by our own parent a moment ago
    threading.Thread(target=_end_with_parent, daemon=True).start()
    render_missing(scene, mask, Path(cache_folder))


if __name__ == "__main__":
    _main()

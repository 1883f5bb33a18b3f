"""Rendering ahead in a child process at low priority, so that the live program never waits for it.

The processes share only the image files in the cache. The child ends when its standard input closes, which happens
however the parent ends.
"""

import os
import pickle
import subprocess
import sys
import threading
from pathlib import Path

from simulated_devices.rendering import ImageCache, Renderer, Scene


class RenderingAhead:
    """A child process that renders the states of one mask that the cache lacks."""

    def __init__(self, scene: Scene, mask: str, cache_folder: Path) -> None:
        package_parent = str(Path(__file__).resolve().parents[1])
        given = os.environ.get("PYTHONPATH", "").split(os.pathsep)
        search_path = os.pathsep.join([package_parent, *filter(None, given)])  # an empty part is the working directory
        below_normal = getattr(subprocess, "BELOW_NORMAL_PRIORITY_CLASS", 0)  # exists on Windows only
        self._process = subprocess.Popen(
            # -P: nothing from the working directory is imported
            [sys.executable, "-P", "-m", "simulated_devices.rendering_ahead"],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            env={**os.environ, "PYTHONPATH": search_path, "OPENBLAS_NUM_THREADS": "1"},
            creationflags=below_normal,
            start_new_session=True,  # Ctrl-C ends the parent, and that ends this process
        )
        if self._process.stdin is None:  # impossible with a pipe
            raise RuntimeError("the background process has no standard input")
        pickle.dump((scene, mask, str(cache_folder)), self._process.stdin)
        self._process.stdin.flush()

    def close(self) -> None:
        """Kill the process; an image that it has not finished is lost."""
        self._process.kill()
        self._process.wait()
        if self._process.stdin is not None:
            self._process.stdin.close()


def render_missing(scene: Scene, mask: str, cache_folder: Path) -> None:
    """Render, in order, every state that the cache lacks; stop if the cache cannot be written."""
    cache, renderer = ImageCache(cache_folder, scene), Renderer(scene, threads=1)
    for state in range(scene.states):
        if cache.load(mask, state) is None and not cache.save(mask, state, renderer.state(mask, state)):
            return


def _end_with_parent() -> None:
    # sys.stdin.buffer.read() would hold a lock at exit, which makes Python abort.
    while os.read(sys.stdin.fileno(), 1):  # empty once the parent has closed the pipe or died
        pass
    os._exit(0)


def _main() -> None:
    if hasattr(os, "nice"):
        os.nice(10)
    scene, mask, cache_folder = pickle.load(sys.stdin.buffer)  # noqa: S301 - our own parent wrote it
    threading.Thread(target=_end_with_parent, daemon=True).start()
    render_missing(scene, mask, Path(cache_folder))


if __name__ == "__main__":
    _main()

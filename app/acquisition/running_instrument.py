"""A running instrument, as window, commands and scripts see it."""

from typing import TypeAlias

from app.acquisition.remote.connection import Connection
from app.acquisition.worker import Acquisition

RunningInstrument: TypeAlias = Acquisition | Connection  # in this process or in another

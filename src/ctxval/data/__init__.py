"""Recordings of a system: readers of logs, and their mapping to states and inputs at equal steps."""

from ctxval.data.log import Clock, Log, MemoryTable, Message, Signal, Table, TopicLog
from ctxval.data.mapping import Field, LogMapping, Observer
from ctxval.data.readers import READERS, component_names, is_log, read_logs
from ctxval.data.recorded_system import Recorded
from ctxval.data.recordings import Recording, Recordings, read_recordings, recordings_of
from ctxval.data.sampling import Break, Channel

__all__ = [
    "READERS",
    "Break",
    "Channel",
    "Clock",
    "Field",
    "Log",
    "LogMapping",
    "MemoryTable",
    "Message",
    "Observer",
    "Recorded",
    "Recording",
    "Recordings",
    "Signal",
    "Table",
    "TopicLog",
    "component_names",
    "is_log",
    "read_logs",
    "read_recordings",
    "recordings_of",
]

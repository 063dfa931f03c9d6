"""Recordings of a system: readers of logs, and their mapping to states and inputs at equal steps."""

from ctxval.data.log import Clock, Log, MemoryTable, Signal, Table
from ctxval.data.mapping import Field, LogMapping, Observer
from ctxval.data.readers import READERS, is_log, read_logs
from ctxval.data.recordings import Recorded, Recording, Recordings, component_names, read_recordings, recordings_of
from ctxval.data.sampling import Break, Channel
from ctxval.data.topics import Message, TopicLog

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

"""Messages of a rosbag (version 2.0) by topic and time, read one at a time by the package rosbags."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from gsjax import extras
from gsjax.data.errors import DataError

_AGAIN = "Copy the file again; if its recording was interrupted, run rosbag reindex on it."


class Message(NamedTuple):
    """A message as it is stored.

    Attributes:
        topic: its topic.
        recorded: when it was written, nanoseconds.
        content: its bytes.
    """

    topic: str
    recorded: int
    content: bytes


class Bag:
    """An open rosbag. Spaces in the names of topics are replaced by _.

    Args:
        path: the file.

    Raises:
        DataError: there is no such file, or it is damaged, here or while messages are read.
        MissingExtra: rosbags is not installed.
    """

    def __init__(self, path: Path):
        self.path, self._lock = path, threading.Lock()
        reading = extras.load("rosbags.rosbag1", "rosbag", "reading a rosbag")
        typing = extras.load("rosbags.typesys", "rosbag", "reading a rosbag")
        if not path.is_file():
            raise DataError(path, "a rosbag", "no such file", "Check the name.")
        self._types = typing.get_typestore(typing.Stores.ROS1_NOETIC)
        with self._wrapping_errors():
            self._reader = reading.Reader(path)
            self._reader.open()
        self._of: dict[str, list[Any]] = {}
        for connection in self._reader.connections:
            self._of.setdefault(connection.topic.replace(" ", "_"), []).append(connection)

    @property
    def topics(self) -> list[str]:
        """All topics, sorted."""
        return sorted(self._of)

    def messages(
        self, topics: list[str], kind: str, start: int | None = None, stop: int | None = None
    ) -> Iterator[Message]:
        """The messages of some topics, in order of time.

        Args:
            topics: their names; topics that the file lacks are ignored.
            kind: the type of the messages; others are skipped.
            start, stop: the first time, and the first time after the last, nanoseconds; None: all.
        """
        of_topics = (connection for topic in topics for connection in self._of.get(topic, ()))
        connections = [connection for connection in of_topics if connection.msgtype == kind]
        if not connections:  # the library takes an empty list for all
            return
        with self._lock, self._wrapping_errors():
            for connection, recorded, content in self._reader.messages(connections, start, stop):
                yield Message(connection.topic.replace(" ", "_"), recorded, content)

    def first(self, topic: str, kind: str) -> Any | None:
        """The first message of a topic, decoded; None if there is none.

        Args:
            topic: its name.
            kind: the type of the message.
        """
        message = next(self.messages([topic], kind), None)
        return None if message is None else self.decoded(message.content, kind)

    def decoded(self, content: bytes, kind: str) -> Any:
        """A message with the fields of its type.

        Args:
            content: its bytes.
            kind: the type, one of ROS 1's own.
        """
        with self._wrapping_errors():
            return self._types.deserialize_ros1(content, kind)

    @contextmanager
    def _wrapping_errors(self) -> Iterator[None]:
        """Raise a DataError instead of the many kinds of errors that rosbags raises for damaged files."""
        try:
            yield
        except Exception as error:
            found = f"bad data ({type(error).__name__}: {error})"
            raise DataError(self.path, "a rosbag", found, _AGAIN) from None

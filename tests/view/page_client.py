"""A client of the page without a browser: speaks viser's protocol over a websocket, sees every element and moves what users move."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import msgspec
import viser
import zstandard
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Subprotocol


class PageClient:
    """What one browser would know of a page. Elements are found by their label, or the text of a button group by its options."""

    def __init__(self, port: int) -> None:
        self._socket = connect(f"ws://127.0.0.1:{port}", subprotocols=[Subprotocol(f"viser-v{viser.__version__}")], max_size=None)
        self.elements: dict[str, dict[str, Any]] = {}
        """Properties of each GUI element by its id; ``value`` among them."""
        self.nodes: dict[str, dict[str, Any]] = {}
        """Properties of each node of the 3-D scene by its name."""
        self.eye: tuple[float, ...] | None = None
        """Where the page has put this client's camera last."""
        self.downloads: dict[str, list[bytes]] = {}
        """Parts of the files that were sent, by name."""
        self._transfers: dict[str, list[bytes]] = {}
        self._news = threading.Condition()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        # Viser counts a browser as connected once it has told where its camera is.
        self._send(
            type="ViewerCameraMessage", wxyz=(1.0, 0.0, 0.0, 0.0), position=(1.0, 1.0, 1.0), fov=0.7, near=0.01, far=100.0,
            image_height=300, image_width=400, look_at=(0.0, 0.0, 0.0), up_direction=(0.0, 0.0, 1.0),
        )  # fmt: skip

    def close(self) -> None:
        self._socket.close()
        self._reader.join(5.0)

    def _send(self, **message: Any) -> None:
        self._socket.send(msgspec.msgpack.encode(message))

    def _read(self) -> None:
        unpack = zstandard.ZstdDecompressor()
        while True:
            try:
                raw = self._socket.recv()
            except ConnectionClosed:
                with self._news:
                    self._news.notify_all()
                return
            assert isinstance(raw, bytes)
            size, packed = (int.from_bytes(raw[k : k + 8], "little") for k in (0, 8))
            window = msgspec.msgpack.decode(unpack.decompress(raw[16 : 16 + packed], max_output_size=size))
            with self._news:
                for message in window["messages"]:
                    self._take(message)
                self._news.notify_all()

    def _take(self, message: dict[str, Any]) -> None:
        kind = message["type"]
        if kind == "GuiUpdateMessage":
            self.elements.setdefault(message["uuid"], {}).update(message["updates"])
        elif kind == "SceneNodeUpdateMessage":
            self.nodes.setdefault(message["name"], {}).update(message["updates"])
        elif kind in ("SetPositionMessage", "SetOrientationMessage"):
            self.nodes.setdefault(message["name"], {}).update({k: v for k, v in message.items() if k in ("position", "wxyz")})
        elif kind == "SetSceneNodeVisibilityMessage":
            self.nodes.setdefault(message["name"], {})["visible"] = message["visible"]
        elif kind == "GuiRemoveMessage":
            self.elements.pop(message["uuid"], None)
        elif kind == "RemoveSceneNodeMessage":
            self.nodes.pop(message["name"], None)
        elif kind == "FileTransferStartDownload":
            self._transfers[message["transfer_uuid"]] = self.downloads.setdefault(message["filename"], [])
        elif kind == "FileTransferPart":
            self._transfers[message["transfer_uuid"]].append(message["content"])
        elif kind == "SetCameraPositionMessage":
            self.eye = tuple(message["position"])
        elif kind.startswith("Gui") and "props" in message:
            known = self.elements.setdefault(message["uuid"], {})
            known |= {"type": kind, **message["props"], **({"value": message["value"]} if "value" in message else {}), **known}
        elif "props" in message and "name" in message:
            self.nodes.setdefault(message["name"], {}).update(message["props"])

    def until(self, happened: Callable[[], Any], what: str = "", patience: float = 20.0) -> Any:
        """Wait until ``happened()`` is true and return it."""
        end = time.monotonic() + patience
        with self._news:
            while True:
                try:
                    found = happened()
                except StopIteration:
                    found = None
                if found:
                    return found
                if time.monotonic() > end:
                    raise AssertionError(f"{what or happened} did not happen; the page says: {self.texts()}")
                self._news.wait(0.2)

    def texts(self) -> str:
        """All visible text of markdown and HTML elements, one an element."""
        shown = [e for e in self.elements.values() if e.get("visible", True)]
        return "\n".join(str(e.get("_markdown") or e.get("content") or "") for e in shown).strip()

    def _find(self, label: str) -> tuple[str, dict[str, Any]]:
        return next((uuid, e) for uuid, e in self.elements.items() if e.get("label") == label or label in e.get("options", ()))

    def element(self, label: str) -> dict[str, Any]:
        """The element of a label."""
        return self._find(label)[1]

    def labels(self) -> set[str]:
        """Labels of all elements that are there."""
        return {element["label"] for element in self.elements.values() if element.get("label")}

    def value(self, label: str) -> Any:
        return self.until(lambda: self._find(label))[1]["value"]

    def set(self, label: str, value: Any) -> None:
        """What a user does: move the slider, choose the option, press the button of that label."""
        uuid, _ = self.until(lambda: self._find(label), label)
        self._send(type="GuiUpdateMessage", uuid=uuid, updates={"value": value})

    def drag(self, phase: str, **pose: Any) -> None:
        """Move the handle of the 3-D view: ``Start``, ``Update`` with ``position`` and ``wxyz``, or ``End``."""
        kind = "TransformControlsUpdateMessage" if phase == "Update" else f"TransformControlsDrag{phase}Message"
        self._send(type=kind, name="/handle", **pose)

    def press(self, button: str) -> None:
        """Press a button of a group, by its text."""
        uuid = self.until(lambda: next(uuid for uuid, e in self.elements.items() if button in e.get("options", ())), button)
        self._send(type="GuiUpdateMessage", uuid=uuid, updates={"value": button})

"""The lines on the page that say how things stand. HTML, as the page is slow to set Markdown."""

import html
from typing import Any

_NOTE_S = 5.0  # that a note stays
_STYLE = "font-size:0.85em;line-height:1.5;padding:0 0.9em 0.4em"


class Status:
    """A few lines that change; sent only when they do."""

    def __init__(self, gui: Any, text: str = ""):
        self._handle, self._text = gui.add_html(_set(text)), text

    def say(self, text: str) -> None:
        """Shows another text, of which the first line of each paragraph stands out."""
        if text != self._text:
            self._text, self._handle.content = text, _set(text)


def notify(server: Any, title: str, text: str, is_bad: bool = False) -> None:
    """Shows a note on every page that is open; a bad one until somebody closes it."""
    looks = {"color": "red"} if is_bad else {"auto_close_seconds": _NOTE_S}
    for client in server.get_clients().values():
        client.add_notification(title, text, **looks)


def _set(text: str) -> str:
    paragraphs = (paragraph.split("\n") for paragraph in text.split("\n\n"))
    return "".join(
        f'<div style="{_STYLE}"><b>{html.escape(first)}</b>'
        f"{''.join(f'<br>{html.escape(line)}' for line in rest)}</div>"
        for first, *rest in paragraphs
    )

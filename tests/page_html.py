"""What a browser without scripts would make of a page."""

from html.parser import HTMLParser


class Html(HTMLParser):
    """A page's tags, its text outside scripts and styles, its links, and what it would load."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.ids: list[str] = []
        self.links: list[str] = []
        self.loads: list[str] = []
        self.words: list[str] = []
        self._script = False
        self.feed(html)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        for key, value in attrs:
            if key == "id":
                self.ids.append(value)
            elif key in ("src", "href") and value.startswith("#"):
                self.links.append(value[1:])
            elif key in ("src", "href", "action", "srcset", "poster", "data") and not value.startswith(
                "data:"
            ):
                self.loads.append(value)
        self._script = tag in ("script", "style")

    def handle_endtag(self, tag):
        self._script = self._script and tag not in ("script", "style")

    def handle_data(self, data):
        if not self._script:
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())

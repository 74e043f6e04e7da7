"""A strict reading of HTML: what a browser would silently repair is refused."""

from html.parser import HTMLParser

VOID = {"meta", "link", "br", "input", "hr", "img"}
# What may stand in a paragraph, a cell or a heading here.
INLINE = {"a", "i", "span", "b", "code"}


class Nesting(HTMLParser):
    """Refuses what a browser would have to repair."""

    def __init__(self):
        super().__init__(convert_charrefs=True)
        self.open, self.ids, self.text, self.tags, self.scripts = [], set(), [], [], {}

    def handle_starttag(self, tag, attributes):
        names = [name for name, _ in attributes]
        assert len(set(names)) == len(names), f"<{tag}> has an attribute twice"
        identity = dict(attributes).get("id")
        assert identity is None or identity not in self.ids, f"id {identity} twice"
        self.ids.add(identity)
        assert not (self.open and self.open[-1] in {"p", "h1", "h2", "td", "th", "title"} and tag not in INLINE), (self.open, tag)
        self.tags.append((tag, dict(attributes)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert tag not in VOID
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag, f"</{tag}> closes another tag"

    def handle_data(self, data):
        if self.open and self.open[-1] in {"script", "style"}:
            self.scripts[len(self.tags)] = data
        else:
            self.text.append(data)

    def handle_comment(self, data):
        assert "--" not in data


def parsed(page):
    assert page.startswith("<!DOCTYPE html>\n<html lang=")
    checker = Nesting()
    checker.feed(page)
    checker.close()
    assert not checker.open, f"never closed: {checker.open}"
    return checker

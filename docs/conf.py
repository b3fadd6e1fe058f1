"""The site that ``make docs`` builds from the documents, as Sphinx reads them. Nothing comes from the network."""

import re
from pathlib import Path

from sphinx.application import Sphinx

project = "Switchboard"
html_title = "Switchboard"
root_doc = "docs/index"
SPEC_INDEX = "protocol/spec/index"
SPEC_CHAPTERS = "protocol/spec/"
SPEC_FILES = dict(
    re.findall(
        r"^ *- \[([\d.]+) .*?\]\((\w+\.md)\)",
        (Path(__file__).parents[1] / f"{SPEC_INDEX}.md").read_text("utf-8"),
        re.MULTILINE,
    )
)
"""The file of each chapter of the specification, by its number."""

extensions = ["myst_parser"]
# The source folder is the checkout, so that links between documents are the same on the site and in the checkout.
include_patterns = ["docs/**", "protocol/spec/**", "README.md", "CHANGELOG.md", "bench/README.md"]
exclude_patterns = [".*", "build", "relay_server", "tests", "web_client"]
myst_heading_anchors = 6
myst_enable_extensions = ["attrs_inline"]
myst_links_external_new_tab = False
# Examples have placeholders, such as "…", at which highlighting stops.
suppress_warnings = ["misc.highlighting_failure"]
html_theme = "furo"
html_copy_source = False
html_show_sphinx = False
html_show_copyright = False


def linked_references(text: str) -> str:
    """A chapter of the specification with links to the rules and chapters that it names.

    A rule such as 2.5-23 can be linked to by ``#rule-2-5-23``. Of chapters those in parentheses are links.
    """

    def link(match: re.Match[str]) -> str:
        rule, chapter = match["rule"], match["chapter"]
        if rule and rule.split("-")[0] in chapters:
            return f"[{rule}](#{anchor(rule)})"
        if chapter in SPEC_FILES:
            return f"([{chapter}]({SPEC_FILES[chapter]})"
        return match[0]

    def anchor(rule: str) -> str:
        return "rule-" + rule.replace(".", "-")

    chapters = {rule.split("-")[0] for rule in re.findall(r"^\*\*([\d.]+-\d+)\*\* ", text, re.MULTILINE)}
    text = re.sub(
        r"^```.*?^```$|`[^`\n]*`|(?<![\w.*])(?P<rule>\d(?:\.\d+)?-\d+)(?![\w*-])|\((?P<chapter>\d\.\d+)(?=[),;])",
        link,
        text,
        flags=re.DOTALL | re.MULTILINE,
    )
    return re.sub(
        r"^\*\*([\d.]+-\d+)\*\* ", lambda m: f"[**{m[1]}**]{{#{anchor(m[1])}}} ", text, flags=re.MULTILINE
    )


def add_contents(app: Sphinx, page: str, source: list[str]) -> None:
    """Make the navigation of the links in an index: a table of contents for each of its chapters."""
    if page == SPEC_INDEX:
        links = "\n".join(re.findall(r"^ *- \[.*?\]\((.*?)\.md\)", source[0], re.MULTILINE))
        source[0] += f"\n```{{toctree}}\n:hidden:\n\n{links}\n```\n"
    elif page.startswith(SPEC_CHAPTERS):
        source[0] = linked_references(source[0])
    if page == root_doc:
        for title, text in re.findall(r"^## (.*?)$(.*?)(?=^## |\Z)", source[0], re.DOTALL | re.MULTILINE):
            links = "\n".join(re.findall(r"^- \[.*?\]\((.*?)\.md\)", text, re.MULTILINE))
            source[0] += f"\n```{{toctree}}\n:hidden:\n:caption: {title}\n\n{links}\n```\n"


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    app.connect("source-read", add_contents)

"""Checks the length of the sentences in the Markdown pages.

Fails if a sentence has more than 40 words, or if more than 10 % of the sentences of all pages have
more than 25. Tables, code and headings do not count. Run it with the Python environment that
`.ci/run` makes: `target/python/bin/python .ci/sentences.py`.
"""

import re
import subprocess
import sys

from markdown_it import MarkdownIt

LONG, TOO_LONG, LARGEST_SHARE = 25, 40, 0.10
GENERATED = {
    "docs/validation/figures.md",
    "docs/validation/lasting-change/figures.md",
    "docs/command-line.md",
}
# A full stop, question mark or exclamation mark before a capital letter ends a sentence. So does a
# colon at the end of a paragraph, which introduces a list or a code block.
END = re.compile(r"(?<=[.!?])[)\"”*]*\s+(?=[A-Z`*\"“(])")


def paragraphs(text):
    """Yields the first line and the words of each paragraph and list item."""
    tokens = MarkdownIt("commonmark").enable("table").parse(text)
    for before, token in zip(tokens, tokens[1:]):
        if before.type != "paragraph_open" or token.type != "inline":
            continue
        parts = []
        for child in token.children:
            if child.type in ("text", "code_inline"):
                # a piece of code counts as one word
                parts.append(child.content if child.type == "text" else "`code`")
            elif child.type in ("softbreak", "hardbreak"):
                parts.append(" ")
        yield token.map[0] + 1, "".join(parts)


def main():
    listed = subprocess.run(["git", "ls-files", "*.md"], capture_output=True, text=True, check=True)
    sentences, long, failed = 0, 0, False
    for page in sorted(set(listed.stdout.split()) - GENERATED):
        with open(page, encoding="utf-8") as file:
            text = file.read()
        for line, paragraph in paragraphs(text):
            for sentence in END.split(paragraph):
                words = len([word for word in sentence.split() if re.search(r"\w", word)])
                sentences += words > 0
                long += words > LONG
                if words > TOO_LONG:
                    failed = True
                    print(f"{page}:{line}: {words} words, must have at most {TOO_LONG}: {sentence[:100]}…")
    share = long / max(sentences, 1)
    print(f"{sentences} sentences, {100 * share:.1f} % of them with more than {LONG} words")
    if share > LARGEST_SHARE:
        failed = True
        print(f"must be at most {100 * LARGEST_SHARE:.0f} %")
    sys.exit(failed)


main()

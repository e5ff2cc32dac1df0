"""Checks licences and sources of all dependencies against the lists of `deny.toml`.

It covers the dependencies for all platforms, and those of the tests. It does what `cargo deny check
licenses sources` does, without the minutes that cargo-deny takes to compile. It evaluates the
stated licence expressions, but does not read licence texts.
"""

import json
import re
import subprocess
import sys
import tomllib


def is_allowed(expression, allowed):
    """Evaluates an SPDX expression. `AND` binds more tightly than `OR`; `/` is an old `OR`."""
    words = re.findall(r"[()]|[^\s()/]+|/", expression)
    words = ["OR" if word == "/" else word for word in words]

    def alternatives():
        holds = together()
        while words and words[0] == "OR":
            words.pop(0)
            holds = together() or holds
        return holds

    def together():
        holds = single()
        while words and words[0] == "AND":
            words.pop(0)
            holds = single() and holds
        return holds

    def single():
        word = words.pop(0)
        if word == "(":
            holds = alternatives()
            words.pop(0)
            return holds
        if words and words[0] == "WITH":
            word = f"{word} {words.pop(0)} {words.pop(0)}"
        return word in allowed

    holds = alternatives()
    return holds and not words


def used():
    """Returns the packages that the workspace needs on any platform, as `cargo metadata` states them.

    `cargo metadata` also lists optional dependencies of dependencies that nothing enables. `cargo
    tree` does not.
    """
    metadata = json.loads(output("cargo", "metadata", "--format-version", "1", "--locked"))
    tree = output(
        *("cargo", "tree", "--locked", "--workspace", "--target", "all", "--edges", "all"),
        *("--prefix", "none", "--format", "{p}"),
    )
    needed = {tuple(line.split()[:2]) for line in tree.splitlines() if line}
    return [
        package
        for package in metadata["packages"]
        if (package["name"], f"v{package['version']}") in needed
    ]


def output(*command):
    return subprocess.check_output(command, text=True)


def mistakes(packages, rules):
    """Yields a sentence for each package that the rules refuse."""
    licences = set(rules["licenses"]["allow"])
    sources = {f"registry+{registry}" for registry in rules["sources"]["allow-registry"]}
    for package in packages:
        name = f"{package['name']} {package['version']}"
        licence, source = package["license"], package["source"]
        if source is not None and source not in sources:
            yield f"{name}: its source is {source}, must be one of {', '.join(sorted(sources))}"
        if licence is None:
            yield f"{name}: states no licence"
        elif not is_allowed(licence, licences):
            yield f"{name}: its licence is {licence}, must be allowed by deny.toml"


def main():
    with open("deny.toml", "rb") as file:
        rules = tomllib.load(file)
    packages = used()
    found = list(mistakes(packages, rules))
    print(f"{len(packages)} packages, {len(found)} refused")
    sys.exit("\n".join(found) or None)


if __name__ == "__main__":
    main()

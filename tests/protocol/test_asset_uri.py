"""URIs of assets."""

from __future__ import annotations

import pytest

from relay_protocol import asset_uri


@pytest.mark.parametrize(
    ("uri", "path"),
    [
        ("package://rover/big.stl", "big.stl"),
        ("package://rover/%62ig.stl", "big.stl"),
        ("package://rover/a%2fb.stl", "a/b.stl"),
        ("package://rover/a/b.stl", "a/b.stl"),
        ("package://rover/%2562ig.stl", "%62ig.stl"),
        ("package://rover/B%C3%A4r.stl", "Bär.stl"),
    ],
)
def test_each_spelling_names_the_same(uri: str, path: str) -> None:
    assert asset_uri.parse(uri) == ("rover", path)

"""The link is cut 50 times, after any byte in either direction, while files are uploaded: none is lost."""

from __future__ import annotations

import hashlib
import random
from pathlib import Path

import pytest

from tests.worlds.file_uploads import FileWorld, Steps, Wire

CUTS = 50
PART = 16 * 1024


class CutWorld(FileWorld):
    """A robot and a relay whose link is cut after a number of bytes.

    :ivar budget: bytes that are still delivered, in both directions
    """

    budget = 10**12

    def pump(self) -> bool:
        for wire in self.wires:
            wire.outgoing = [self._passed(wire)]
        some = super().pump()
        if self.budget <= 0:
            self.budget = 10**12
            self.cut()
            self.cuts += 1
        return some

    cuts = 0

    def _passed(self, wire: Wire) -> bytes:
        data = b"".join(wire.outgoing)[: max(0, self.budget)]
        self.budget -= len(data)
        return data


def check_nothing_is_lost(world: FileWorld, contents: dict[str, bytes]) -> None:
    """Each file is complete on the robot, or listed with its hash and complete at the relay."""
    stored = {each.name: each for each in world.stored()}
    for name, content in contents.items():
        path = world.folder / name
        if path.exists():
            assert path.read_bytes() == content
        else:
            file = stored[f"bags/{name}"]
            assert file.sha256 == hashlib.sha256(content).hexdigest()
            assert world.read(file) == content


@pytest.mark.parametrize("seed", range(1))
def test_no_file_is_lost_by_50_cuts_at_any_byte(tmp_path: Path, seed: int) -> None:
    world, chance = CutWorld(tmp_path), random.Random(seed)
    contents: dict[str, bytes] = {}
    while world.cuts < CUTS:
        if len(list(world.folder.iterdir())) < 4:
            name = f"run-{len(contents):03}.bag"
            contents[name] = chance.randbytes(chance.choice([1, PART, PART + 1, 5 * PART, 20 * PART]))
            world.write(name, contents[name])
        world.budget = chance.choice([chance.randrange(1, 2000), chance.randrange(1, 10 * PART)])
        before = world.cuts
        while world.cuts == before:
            world.run(1)
            if len(list(world.folder.iterdir())) == 0:
                break
        check_nothing_is_lost(world, contents)
        end = chance.random()
        if end < 0.15:
            world.cut()
            world.start_relay(Steps())
        elif end < 0.3:
            world.cut()
            world.start_robot(Steps())
    world.budget = 10**12
    world.run(60)
    check_nothing_is_lost(world, contents)
    assert list(world.folder.iterdir()) == []
    assert len(world.stored()) == len(contents)
    assert world.incoming() == []

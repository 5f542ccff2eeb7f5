"""``tools/cuda_usage.py`` reads what a compiled kernel takes; the compiler is in Warp's wheel."""

from __future__ import annotations

import cuda_usage as tool
from markdown_cells import cells_of


def test_registers_are_read_from_the_binary(monkeypatch):
    """A small module for two architectures: every kernel has registers, and Warp's own shared bytes are seen."""
    (module,) = [module for module in tool.modules() if module.name.endswith(".closest_point")]
    monkeypatch.setattr(tool, "modules", lambda: [module])
    rows = cells_of(tool.cuda_usage(architectures=(75, 90)))[1:]
    assert {row[1] for row in rows} == {"75", "90"}
    assert {row[0] for row in rows} == {"closest_point: closest_point"}
    for _, _, registers, shared, local in rows:
        assert 8 <= int(registers) <= 255
        assert int(shared) > 0
        assert int(local) >= 0

"""Numbers of links and coordinates are a mechanism's: no literal 3 or 6 stands for them."""

import ast

import pytest

from tests import TOP
from tests.house.test_house import SOURCES

#: Calls whose arguments are sizes or shapes.
SHAPED = {
    "arange",
    "broadcast_to",
    "combinations",
    "empty",
    "eye",
    "full",
    "ndindex",
    "normal",
    "ones",
    "permutations",
    "range",
    "repeat",
    "reshape",
    "tile",
    "uniform",
    "zeros",
}
#: Mechanisms, and what is about the 3-PRR alone: the cards of papers, the coupling atlas of its
#: links, the same machine in other codes, the paper's run.
OF_ONE_MACHINE = (
    "jaxmodel/defaults.py",
    "jaxmodel/mechanisms/",
    "studies/atlas/",
    "studies/papers/",
    "studies/reference/slider_crank.py",
)
#: Threes and sixes that count something else: coefficients, stages of a step, entries of a message.
OTHERS = {
    "jaxmodel/actuation.py": ("range(3)",),
    "jaxmodel/damping.py": ("np.ones(6)",),
    "jaxmodel/dynamics.py": ("len(m) == 3",),
    "jaxmodel/sampled_response.py": ("range(3)",),
    "jaxmodel/laws/contract.py": (":3",),
    "jaxmodel/laws/ppf.py": ("(zero,) * 3",),
    "jaxmodel/loop.py": ("range(3)",),
    "jaxmodel/robustness.py": ("range(6)",),
    "jaxmodel/trigonometry.py": ("range(3)",),
    "studies/cluster/connect.py": (":3", "len(faults) > 3"),
    "studies/commission/stages.py": (":3",),
    "studies/engine/disk_margin.py": (
        "_local_maxima(grid.omega, value).reshape(-1, 3)",
        "bracket.reshape(n, FOLLOWED, 3)",
        "range(3)",
    ),
    "studies/engine/function.py": (":3",),
    "studies/engine/host_loop.py": ("range(3)",),
    "studies/engine/margins.py": ("np.full((3, count), np.nan)",),
    "studies/engine/poles.py": (":3",),
    "studies/engine/run_data.py": (":3",),
    "studies/export/c_drive.py": ("rng.normal(size=(3, SAMPLES, code.structure.n_links))",),
    "studies/export/c_fixed.py": (":3",),
    "studies/export/c_floating.py": (":3",),
    "studies/export/c_text.py": ("range(0, len(numbers), 3)",),
    "studies/export/compiler.py": ("3 * n_modes",),
    "studies/export/document.py": ("1:3",),
    "studies/export/firmware/emulator.py": ("range(6)",),
    "studies/export/fixed.py": (":3", "np.zeros((3, exported.n_links, exported.n_patches))"),
    "studies/export/fixed_blocks.py": (
        "1:3",
        "np.zeros((3, exported.n_links, exported.n_patches))",
    ),
    "studies/export/floating.py": (":3",),
    "studies/export/integers.py": ("np.zeros((3, *many, len(fixed.link)), np.int64)",),
    "studies/fitting/kinds/settling.py": (":6", "np.arange(6)", "np.zeros(6)"),
    "studies/fitting/profiles.py": ("len(self.values) < 3",),
    "studies/job.py": (":3",),
    "studies/kernels/differentiable.py": ("3:",),
    "studies/kernels/vectors.py": ("[ir.PointerType()] * 3",),
    "studies/show/pages.py": ("6:8",),
    "studies/space/methods.py": (":3",),
    "studies/spillover/certificate.py": ("np.full((3, *shape, largest, links), np.nan)",),
    "studies/spillover/proofs.py": (":3",),
    "studies/study/state_space.py": (":3",),
    "studies/study/window.py": ("np.zeros((study.n_links, 2, 3))", "range(3)"),
    "studies/sweeps/say.py": (":3", "len(best) > 3", "len(fine) >= 3"),
    "studies/tuning/evaluate.py": ("3:",),
    "studies/twin/electronics.py": (":3", "np.zeros((3, *shape))"),
    "studies/twin/multibody.py": ("np.eye(3)",),
}


def is_size(node):
    parts = node.elts if isinstance(node, (ast.Tuple, ast.List)) else [node]
    return any(
        isinstance(x, ast.Constant) and type(x.value) is int and x.value in (3, 6) for x in parts
    )


def name_of(function):
    return function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")


def looks_like_a_size(node):
    if isinstance(node, ast.Call) and name_of(node.func) in SHAPED:
        named = [x.value for x in node.keywords if x.arg in ("shape", "size", "repeat")]
        return any(map(is_size, [*node.args, *named]))
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mult):
        pairs = ((node.left, node.right), (node.right, node.left))
        return any(isinstance(a, ast.Constant) and is_size(a) and is_counted(b) for a, b in pairs)
    if isinstance(node, ast.Slice):
        return any(x is not None and is_size(x) for x in (node.lower, node.upper))
    if isinstance(node, ast.Compare):
        return "len(" in ast.unparse(node) and any(map(is_size, node.comparators))
    return False


def is_counted(node):
    """Lists, and numbers of modes, patches, links."""
    if isinstance(node, (ast.Tuple, ast.List)):
        return True
    words = ("modes", "patches", "links", "channels", "count")
    is_named = isinstance(node, (ast.Name, ast.Attribute))
    return is_named and any(word in ast.unparse(node) for word in words)


def found_in(tree):
    return {ast.unparse(node) for node in ast.walk(tree) if looks_like_a_size(node)}


def test_no_literal_stands_for_a_number_of_links_or_coordinates():
    found = {}
    for path, tree in SOURCES.items():
        name = path.relative_to(TOP).as_posix()
        if not name.startswith(OF_ONE_MACHINE) and (own := found_in(tree)):
            found[name] = own
    assert found == {name: set(own) for name, own in OTHERS.items()}


@pytest.mark.parametrize(
    "line",
    ["np.zeros((3, n))", "x[..., :3]", "(True,) * 3", "3 * n_patches", "range(3)", "len(x) != 3"],
)
def test_what_is_looked_for_is_found(line):
    assert found_in(ast.parse(line))

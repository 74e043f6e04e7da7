"""What ``import chargetune as ct`` offers, and what it costs."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import chargetune as ct


@pytest.mark.parametrize("name", ct.__all__)
def test_each_name_is_what_its_module_says(name):
    found = getattr(ct, name)
    assert name in {"__version__", getattr(found, "__name__", None)}
    assert name in dir(ct)


def test_names_are_listed_once_and_no_other_is_known():
    assert len(set(ct.__all__)) == len(ct.__all__)
    assert {"Controller", "Study", "SimulatedTwin", "score_limits"} <= set(ct.__all__)
    with pytest.raises(AttributeError, match="no attribute 'Modle'"):
        _ = ct.Modle


def test_a_name_loads_what_it_needs_and_no_more():
    """The package alone loads neither CasADi nor torch (test_package); a parameter needs neither, a model no torch, a command no SciPy.

    That a Gaussian process does is seen where torch cannot be imported, which is quicker than importing it.
    """
    code = (
        "import sys, chargetune as ct\n"
        "ct.Parameter; print('casadi' in sys.modules, 'torch' in sys.modules)\n"
        "ct.Model, ct.simulate, ct.score_limits, ct.Safety, ct.Study; print('casadi' in sys.modules, 'torch' in sys.modules)\n"
        "import chargetune.cli.tune, chargetune.cli.show, chargetune.cli.certify; print('scipy' in sys.modules)\n"
        "sys.modules['torch'] = None\n"
        "try:\n    ct.ConstrainedLogEI\nexcept ImportError as error:\n    print(error.name)"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120)
    assert run.stdout.split() == ["False", "False", "True", "False", "False", "torch"]


def test_a_type_checker_sees_the_same_names():
    """The imports for type checkers, the table that is used at run time, and ``__all__``: three lists of the same."""
    tree = ast.parse(Path(ct.__file__).read_text(encoding="utf-8"))
    (checked,) = [node for node in tree.body if isinstance(node, ast.If)]
    assert ast.unparse(checked.test) == "TYPE_CHECKING"
    seen = {alias.name: node.module for node in checked.body for alias in node.names}
    assert seen == {name: f"chargetune.{module}" for name, module in ct._MODULES.items()}
    assert {*seen, "__version__"} == set(ct.__all__)
    assert list(ct.__all__) == sorted(ct.__all__)

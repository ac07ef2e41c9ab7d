"""Print mutants of the package, drawn at random, as CSV: python tests/mutation/draw.py --n 300 --seed 0.

A mutant is one changed node of a syntax tree. The file, the function and the statement before and after identify it,
so that a list stays valid when lines move. (mutmut 3.8 changes neither properties nor constants.)
"""

import argparse
import ast
import copy
import csv
import random
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
FIELDS = ["id", "file", "function", "original", "mutated", "occurrence"]
SWAPS = {
    "Lt": "LtE GtE", "LtE": "Lt Gt", "Gt": "GtE LtE", "GtE": "Gt Lt", "Eq": "NotEq", "NotEq": "Eq", "Is": "IsNot",
    "IsNot": "Is", "In": "NotIn", "NotIn": "In", "And": "Or", "Or": "And", "Add": "Sub", "Sub": "Add", "Mult": "Div",
    "Div": "Mult", "FloorDiv": "Div", "Mod": "Mult", "Pow": "Mult", "MatMult": "Mult",
}  # fmt: skip


def variants(node: Any) -> Iterator[ast.AST]:
    """What a node may become."""
    op = node.ops[0] if isinstance(node, ast.Compare) else getattr(node, "op", None)
    for name in SWAPS.get(type(op).__name__, "").split():
        new, swapped = copy.copy(node), getattr(ast, name)()
        vars(new).update({"ops": [swapped, *node.ops[1:]]} if isinstance(node, ast.Compare) else {"op": swapped})
        yield new
    match node:
        case ast.UnaryOp(op=ast.Not() | ast.USub(), operand=operand):
            yield operand
        case ast.Constant(value=bool(value)):
            yield ast.Constant(not value)
        case ast.Constant(value=int(value) | float(value)):
            yield ast.Constant(value * 2 if value and isinstance(value, float) else value + 1)
        case ast.Return(value=ast.expr()) if ast.unparse(node) != "return None":
            yield ast.Return(ast.Constant(None))
        case ast.Slice(lower=lower, upper=upper) if lower or upper:
            yield ast.Slice(None, upper) if lower else ast.Slice(lower, None)
        case ast.AugAssign() | ast.Expr(value=ast.Call()):
            yield ast.Pass()


def mutants(container: Any, key: Any, function: str = "", whole: Any = None) -> Iterator[tuple[str, str, str]]:
    """Function, and statement before and after, of each mutant of the node `container[key]` and of what is in it."""
    node = container[key]
    match node:
        case ast.Raise() | ast.JoinedStr() | ast.Assign(targets=[ast.Name("__all__")]):
            return
        case ast.BinOp(op=ast.BitOr()) if not function:  # a type
            return
        case ast.FunctionDef() | ast.ClassDef():
            function = f"{function}.{node.name}".lstrip(".")
    if isinstance(node, (ast.expr, ast.stmt)) and not hasattr(node, "body") and not isinstance(node, ast.Match):
        whole = whole or (container, key)  # the statement, or the expression in the first line of a compound statement
        before = ast.unparse(whole[0][whole[1]])
        for new in variants(node):
            container[key] = new
            yield function, before, ast.unparse(whole[0][whole[1]])
            container[key] = node
    for name, value in ast.iter_fields(node):
        if name not in ("annotation", "returns", "decorator_list"):
            slots: Any = [(value, i) for i in range(len(value))] if isinstance(value, list) else [(vars(node), name)]
            for inner in [slot for slot in slots if isinstance(slot[0][slot[1]], ast.AST)]:
                yield from mutants(*inner, function, whole)


def main() -> None:
    """Read the command line, draw and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--n", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    found, seen = [], Counter[tuple[str, ...]]()
    for path in sorted((ROOT / "skevgp").rglob("*.py")):
        for names in mutants([ast.parse(path.read_text(encoding="utf-8"))], 0):
            row = (path.relative_to(ROOT).as_posix(), *names)
            found.append([*row, seen[row]])
            seen[row] += 1
    drawn = random.Random(args.seed).sample(found, args.n)
    csv.writer(sys.stdout, lineterminator="\n").writerows([FIELDS, *([i, *row] for i, row in enumerate(drawn))])


if __name__ == "__main__":
    main()

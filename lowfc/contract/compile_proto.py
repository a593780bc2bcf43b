"""Compile the `.proto` file into `lowfc/contract/wire`; a development tool, run by `make proto`.

Example:
    python -m lowfc.contract.compile_proto            # rewrite the committed code
    python -m lowfc.contract.compile_proto --into DIR # into another folder, to compare
"""

import argparse
import shutil
import tempfile
from pathlib import Path

CONTRACT = Path(__file__).parent
SOURCE = "lowfc/v1/lowfc.proto"


def compile_into(target: Path) -> list[Path]:
    """Write lowfc_pb2.py, its stub and the descriptor with comments into the folder `target`; return their paths."""
    from importlib.resources import files

    from grpc_tools import protoc

    with tempfile.TemporaryDirectory() as work:
        arguments = [
            "protoc",
            f"-I{CONTRACT / 'proto'}",
            f"-I{files('grpc_tools') / '_proto'}",
            f"--python_out={work}",
            f"--pyi_out={work}",
            f"--descriptor_set_out={Path(work) / 'lowfc.desc'}",
            "--include_imports",
            "--include_source_info",
            SOURCE,
        ]
        if protoc.main(arguments) != 0:
            raise SystemExit(f"protoc refused {SOURCE}")
        generated = [Path(work) / "lowfc.desc", *sorted((Path(work) / "lowfc/v1").iterdir())]
        return [Path(shutil.copy(path, target / path.name)) for path in generated]


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--into", type=Path, default=CONTRACT / "wire")
    compile_into(parser.parse_args().into)


if __name__ == "__main__":
    main()

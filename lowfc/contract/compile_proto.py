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


def main() -> None:
    """Write lowfc_pb2.py, its stub and the descriptor with comments into a folder."""
    from importlib.resources import files

    from grpc_tools import protoc

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--into", type=Path, default=CONTRACT / "wire")
    target = parser.parse_args().into
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
        for path in (Path(work) / "lowfc.desc", *(Path(work) / "lowfc/v1").iterdir()):
            shutil.copy(path, target)


if __name__ == "__main__":
    main()

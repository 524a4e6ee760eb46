"""``python -m cudc_bench.cli`` is ``cudc-bench``."""

from cudc_bench.cli.app import main

if __name__ == "__main__":
    main()

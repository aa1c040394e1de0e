"""Run the command `slipid` by `python -m slipid`."""

from slipid.cli.main import main

if __name__ == "__main__":
    main()

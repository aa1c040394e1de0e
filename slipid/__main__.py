"""`python -m slipid` is the command `slipid`."""

from slipid.cli.main import main

if __name__ == "__main__":
    main()

"""`python -m det2stoc_bayes` is the command `det2stoc`."""

from det2stoc_bayes.cli import main

if __name__ == "__main__":
    main()

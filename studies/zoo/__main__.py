"""Run the study: ``python -m studies.zoo``."""

from studies.zoo import main

if __name__ == "__main__":
    main()

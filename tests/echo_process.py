"""A child for the tests of bounded processes: reports its request, then ends, hangs or aborts as requested."""

import os
import sys
import time

from fdhil.bounded_process import limit_process, receive_request, report_to_parent


def main() -> None:
    limit_process(0, {})
    request = receive_request()
    report_to_parent({"request": request, "pid": os.getpid()})
    if request["then"] == "hang":
        time.sleep(1000)
    elif request["then"] == "break off":
        sys.stdout.write('{"cut": ')
        sys.stdout.flush()
        sys.exit(3)


if __name__ == "__main__":
    main()

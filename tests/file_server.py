"""Serve the files of a folder: in ranges over HTTP, and as an object store, whose buckets are the folders in it.

python tests/file_server.py FOLDER   serves them until it is ended, and prints its address.
"""

from __future__ import annotations

import argparse
import threading
from email.utils import formatdate
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import parse_qs, unquote, urlsplit
from xml.sax.saxutils import escape

PRIVATE = "private"
"""A bucket that nobody may read."""


class FileServer(ThreadingHTTPServer):
    """A server on a free port of this machine.

    Attributes:
        requests: method, path and range of each request.
        ranges: whether it sends parts of files.
    """

    daemon_threads = True

    def __init__(self, folder: Path, ranges: bool = True) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.folder, self.ranges, self.requests = folder, ranges, list[tuple[str, str, str | None]]()
        self.address = f"http://127.0.0.1:{self.server_port}"

    def __enter__(self) -> FileServer:
        threading.Thread(target=self.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self.shutdown()
        self.server_close()

    def bytes_sent(self, name: str) -> int:
        """Return how many bytes of the files with a name in their path were asked for, in ranges."""
        asked = [each[2] for each in self.requests if name in each[1] and each[0] == "GET" and each[2]]
        return sum(int(stop) - int(start) + 1 for start, stop in (each.removeprefix("bytes=").split("-") for each in asked))


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: FileServer

    def log_message(self, *_: object) -> None:
        pass

    def do_HEAD(self) -> None:
        self.do_GET()

    def do_GET(self) -> None:
        parts = urlsplit(self.path)
        name, query = unquote(parts.path).strip("/"), parse_qs(parts.query)
        self.server.requests.append((self.command, name, self.headers.get("Range")))
        path = self.server.folder / name
        if name.split("/")[0] == PRIVATE:
            self._error(403, "AccessDenied")
        elif "list-type" in query and path.is_dir():
            self._list(path, query.get("prefix", [""])[0], query.get("delimiter", [""])[0])
        elif path.is_file():
            self._file(path)
        else:
            self._error(404, "NoSuchKey" if (self.server.folder / name.split("/")[0]).is_dir() else "NoSuchBucket")

    def _file(self, path: Path) -> None:
        size, start = path.stat().st_size, 0
        stop, asked = size, self.headers.get("Range") if self.server.ranges else None
        if asked:
            first, _, last = asked.removeprefix("bytes=").partition("-")
            start, stop = int(first), min(int(last) + 1, size) if last else size
            if start >= size:
                self._error(416, "InvalidRange")
                return
        self.send_response(206 if asked else 200)
        self.send_header("Content-Length", str(stop - start))
        self.send_header("ETag", f'"{path.stat().st_mtime_ns:x}-{size:x}"')
        self.send_header("Last-Modified", formatdate(path.stat().st_mtime, usegmt=True))
        if self.server.ranges:
            self.send_header("Accept-Ranges", "bytes")
        if asked:
            self.send_header("Content-Range", f"bytes {start}-{stop - 1}/{size}")
        self.end_headers()
        if self.command == "GET":
            self.wfile.flush()
            with path.open("rb") as file:
                try:
                    self.connection.sendfile(file, start, stop - start)
                except (BrokenPipeError, ConnectionResetError):
                    self.close_connection = True

    def _list(self, bucket: Path, prefix: str, delimiter: str) -> None:
        keys = sorted(path.relative_to(bucket).as_posix() for path in bucket.rglob("*") if path.is_file())
        keys, folders = [key for key in keys if key.startswith(prefix)], set[str]()
        if delimiter:
            folders = {prefix + key[len(prefix) :].partition("/")[0] + "/" for key in keys if "/" in key[len(prefix) :]}
            keys = [key for key in keys if "/" not in key[len(prefix) :]]
        found = "".join(
            f"<Contents><Key>{escape(key)}</Key><Size>{(bucket / key).stat().st_size}</Size>"
            "<LastModified>2024-01-01T00:00:00Z</LastModified></Contents>"
            for key in keys
        )
        found += "".join(f"<CommonPrefixes><Prefix>{escape(each)}</Prefix></CommonPrefixes>" for each in sorted(folders))
        number = len(keys) + len(folders)
        self._text(
            200, f"<ListBucketResult><IsTruncated>false</IsTruncated><KeyCount>{number}</KeyCount>{found}</ListBucketResult>"
        )

    def _error(self, status: int, code: str) -> None:
        self._text(status, f"<Error><Code>{code}</Code><Message>{code}</Message></Error>")

    def _text(self, status: int, text: str) -> None:
        self.send_response(status)
        self.send_header("Content-Type", "application/xml")
        self.send_header("Content-Length", str(len(text.encode())))
        self.end_headers()
        if self.command == "GET":
            self.wfile.write(text.encode())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    server = FileServer(parser.parse_args().folder.absolute())
    print(server.address, flush=True)
    server.serve_forever()

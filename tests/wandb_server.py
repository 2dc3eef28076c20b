"""As much of a W&B server as ``wandb sync`` talks to: it keeps what it is sent of each run."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

HISTORY, SUMMARY = "wandb-history.jsonl", "wandb-summary.json"


class WandbServer(ThreadingHTTPServer):
    """Keeps, by the ids of runs, the lines of their histories as the real one does.

    Attributes:
        history: lines by number, each as it was last sent.
        summaries: the last of each run.
        media: names of the files that came with them.
        settings: what each run was described by.
        operations: that were asked for.
    """

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.history: dict[str, dict[int, dict[str, Any]]] = {}
        self.summaries: dict[str, dict[str, Any]] = {}
        self.settings: dict[str, dict[str, Any]] = {}
        self.media: list[str] = []
        self.operations: list[str] = []

    @property
    def url(self) -> str:
        """Where it is."""
        return f"http://127.0.0.1:{self.server_address[1]}"

    def answer(self, operation: str, variables: dict[str, Any]) -> dict[str, Any]:
        """The data of a GraphQL operation."""
        self.operations.append(operation)
        run = str(variables.get("name") or variables.get("run"))
        project = {"id": "p", "name": "p", "entity": {"id": "e", "name": "lab"}}
        if operation == "UpsertBucket":
            given = {key: value for key, value in variables.items() if value is not None}
            self.settings[run] = {**self.settings.get(run, {}), **given}
            self.history.setdefault(run, {})
            bucket = {
                **{"id": run, "name": run, "displayName": "x", "description": "", "config": "{}"},
                **{"sweepName": None, "project": project, "historyLineCount": None},
            }
            return {"upsertBucket": {"bucket": bucket, "inserted": True}}
        if operation == "RunResumeStatus":
            known = run in self.history
            return {
                "model": {"id": "p", "name": "p", "bucket": self._status(run) if known else None}
            }
        if operation == "Viewer":
            viewer = {"id": "v", "entity": "lab", "username": "lab", "email": "", "admin": False}
            teams: dict[str, Any] = {"edges": []}
            return {"viewer": {**viewer, "flags": "{}", "teams": teams}}
        if operation == "CreateRunFiles":
            names = variables.get("files") or []
            self.media += names
            urls = [{"name": name, "uploadUrl": f"{self.url}/upload"} for name in names]
            return {"createRunFiles": {"runID": run, "uploadHeaders": [], "files": urls}}
        return {}

    def _status(self, run: str) -> dict[str, Any]:
        lines = self.history[run]
        tail = [json.dumps(lines[max(lines)])] if lines else []
        return {
            **{"id": run, "name": run, "historyLineCount": len(lines), "eventsLineCount": 0},
            **{"logLineCount": 0, "historyTail": json.dumps(tail), "eventsTail": "[]"},
            "summaryMetrics": json.dumps(self.summaries.get(run, {})),
            **{"config": "{}", "tags": [], "wandbConfig": '{"t": 1}'},
        }

    def stream(self, run: str, content: dict[str, Any]) -> None:
        """Take lines of a run's files."""
        files = content.get("files") or {}
        part = files.get(HISTORY)
        if part:
            lines = [json.loads(line) for line in part["content"]]
            kept = self.history.setdefault(run, {})
            kept.update(enumerate(lines, start=int(part["offset"])))
        if SUMMARY in files:
            self.summaries[run] = json.loads(files[SUMMARY]["content"][-1])


class _Handler(BaseHTTPRequestHandler):
    server: WandbServer

    def _body(self) -> Any:
        raw = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        return json.loads(raw) if self.path.endswith(("/graphql", "/file_stream")) else {}

    def _reply(self, content: Any) -> None:
        raw = json.dumps(content).encode()
        self.send_response(200)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(raw)))
        self.end_headers()
        self.wfile.write(raw)

    def do_POST(self) -> None:
        body = self._body()
        if self.path.endswith("/graphql"):
            name = body.get("operationName") or ""
            self._reply({"data": self.server.answer(name, body.get("variables") or {})})
        elif self.path.endswith("/file_stream"):
            self.server.stream(self.path.split("/")[-2], body)
            self._reply({})
        else:
            self._reply({})

    def do_PUT(self) -> None:
        self.rfile.read(int(self.headers.get("Content-Length", 0)))
        self._reply({})

    def do_GET(self) -> None:
        self._reply({})

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing."""


@contextmanager
def wandb_server() -> Iterator[WandbServer]:
    """A server for as long as the block lasts."""
    server = WandbServer()
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        server.server_close()
        thread.join()

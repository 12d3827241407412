# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""
A Hugging Face Hub in one process: what huggingface_hub calls to push and pull, and faults.

Repositories are in memory. Large files go by git-lfs, as `preupload` decides, and come back by a
redirect to a store of their own. Where hf_xet is not disabled they go by Xet, as on the real Hub,
to a folder instead of a server.
"""

import base64
from contextlib import contextmanager
from dataclasses import dataclass, field
import hashlib
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
import json
import re
from threading import Event, Thread
import time
from urllib.parse import unquote, urlsplit

OWNER, TOKEN, READER = 'someone', 'hf_writer', 'hf_reader'
LARGE = 4096  # bytes; from here on a file goes by git-lfs


@dataclass
class Repository:
    """Commits of one repository: {path: content} by hash, and those that branches end with."""

    private: bool
    commits: dict = field(default_factory=dict)
    branches: dict = field(default_factory=dict)

    def commit(self, branch, files):
        """Add a commit; return its hash."""
        before = self.branches.get(branch)
        tree = {**self.commits.get(before, {}), **files}
        text = json.dumps([before, branch, sorted(
            (name, _sha256(data)) for name, data in tree.items())])
        self.branches[branch] = commit = hashlib.sha1(text.encode()).hexdigest()
        self.commits[commit] = tree
        return commit

    def find(self, revision):
        """Return the hash of a commit, by itself or by its branch; None: there is none."""
        return self.branches.get(revision, revision if revision in self.commits else None)


class Hub(ThreadingHTTPServer):
    """
    The server.

    Faults, of the downloads of large files: `cuts`, how many more break off half way; `dies`,
    whether nobody listens after that; `stalls`, whether they stop half way until the server ends.
    Of all requests: `status`, answered to each.

    :param xet: folder for what comes by Xet.
    """

    daemon_threads = True

    def __init__(self, xet):
        super().__init__(('127.0.0.1', 0), Handler)
        self.xet, self.xet_hashes = xet, {}
        self.repositories, self.large, self.requests = {}, {}, []
        self.cuts, self.dies, self.stalls, self.status = 0, False, False, None
        self.stalled, self.ended = Event(), Event()
        self.url = f'http://127.0.0.1:{self.server_port}'
        self.store = f'http://localhost:{self.server_port}/store'  # another host to a client

    def add(self, name, files, private=False):
        """Commit {path: bytes} to the main branch of a repository; return the commit."""
        repository = self.repositories.setdefault(name, Repository(private))
        return repository.commit('main', files)

    def expect_by_xet(self, *paths):
        """Learn which content has which Xet hash; the real Hub is told by Xet's servers."""
        import hf_xet
        for path, found in zip(paths, hf_xet.hash_files([str(path) for path in paths])):
            data = path.read_bytes()
            self.large[_sha256(data)], self.xet_hashes[_sha256(data)] = data, found.hash

    def handle_error(self, request, client_address):
        """Say nothing of clients that have gone."""


@contextmanager
def running_hub(xet):
    """Run a Hub in a thread as long as the context lasts; see Hub."""
    hub = Hub(xet)
    thread = Thread(target=hub.serve_forever, args=(0.05,))
    thread.start()
    try:
        yield hub
    finally:
        hub.ended.set()
        hub.shutdown()
        hub.server_close()
        thread.join()


class Refused(Exception):
    """What is answered instead."""

    def __init__(self, status, code='', message='', **more):
        self.status, self.more = status, more
        self.headers = {'X-Error-Code': code, 'X-Error-Message': message}


class Handler(BaseHTTPRequestHandler):
    """Answers a request by the first of ROUTES that fits."""

    def answer(self):
        path, body = unquote(urlsplit(self.path).path), self.body()
        self.server.requests.append((self.command, path, self.headers.get('Authorization')))
        try:
            if self.server.status:
                raise Refused(self.server.status, error='something\n\x1b[31mFORGED')
            for method, pattern, route in ROUTES:
                found = re.fullmatch(pattern, path)
                if found and self.command in method.split():
                    return route(self, body, *found.groups())
            raise Refused(404, message=f'{self.command} {path}: not made')
        except Refused as refused:
            self.send(refused.status, refused.more, refused.headers)

    do_GET = do_HEAD = do_POST = do_PUT = answer

    def body(self):
        """Return what was sent, as bytes."""
        if 'chunked' not in self.headers.get('Transfer-Encoding', ''):
            return self.rfile.read(int(self.headers.get('Content-Length', 0)))
        parts = []
        while size := int(self.rfile.readline(), 16):
            parts.append(self.rfile.read(size))
            self.rfile.readline()
        self.rfile.readline()
        return b''.join(parts)

    def send(self, status, content=b'', headers=()):
        """Answer with bytes, or with JSON."""
        data = content if isinstance(content, bytes) else json.dumps(content).encode()
        self.send_response(status)
        for name, value in dict({'Content-Length': len(data)}, **dict(headers)).items():
            if value != '':
                self.send_header(name, str(value))
        self.end_headers()
        if self.command != 'HEAD':
            self.wfile.write(data)

    def repository(self, name, write=False):
        """Return a repository that the token may read, or write."""
        token = self.headers.get('Authorization', '').removeprefix('Bearer ')
        if token and token not in (TOKEN, READER):
            raise Refused(401, message='Invalid credentials in Authorization header')
        found = self.server.repositories.get(name)
        if found is None or (found.private and not token):
            raise Refused(404 if token else 401, 'RepoNotFound', 'Repository not found')
        if write and token != TOKEN:
            raise Refused(403 if token else 401, '', 'You need write access')
        return found

    def commit_of(self, name, revision):
        """Return a repository and the hash of one of its commits."""
        repository = self.repository(name)
        commit = repository.find(revision)
        if commit is None:
            raise Refused(404, 'RevisionNotFound', f'Invalid rev id: {revision}')
        return repository, commit

    def create(self, body):
        wanted = json.loads(body)
        name = f'{wanted["organization"]}/{wanted["name"]}'
        token = self.headers.get('Authorization', '').removeprefix('Bearer ')
        if token not in (TOKEN, READER):
            raise Refused(401, message='Invalid username or password.')
        if wanted['organization'] != OWNER or token == READER:
            raise Refused(403, message='You have no rights to create a model there')
        url = f'{self.server.url}/{name}'
        if name in self.server.repositories:
            raise Refused(409, message='You already created this repo', url=url)
        repository = Repository(wanted.get('visibility') == 'private')
        repository.commit('main', {'.gitattributes': b'*.safetensors filter=lfs\n'})
        self.server.repositories[name] = repository
        self.send(200, {'url': url})

    def info(self, body, name, revision='main'):
        repository, commit = self.commit_of(name, revision)
        self.send(200, {'id': name, 'sha': commit, 'private': repository.private, 'siblings': [
            {'rfilename': path} for path in sorted(repository.commits[commit])]})

    def validate(self, body):
        content = json.loads(body)['content']
        if 'license: nonsense' in content:
            self.send(400, {'errors': [{'message': '"license" must be a known one'}]})
        else:
            self.send(200, {'errors': [], 'warnings': []})

    def branch(self, body, name, branch):
        repository = self.repository(name, write=True)
        if branch in repository.branches:
            raise Refused(409, message='Reference already exists')
        repository.branches[branch] = repository.branches['main']
        self.send(200, {})

    def preupload(self, body, name, revision):
        repository = self.repository(name, write=True)
        commit = repository.find(revision)
        self.send(200, {'files': [{
            'path': each['path'], 'shouldIgnore': False,
            'uploadMode': 'lfs' if each['size'] >= LARGE else 'regular',
            'oid': _oid(repository.commits[commit].get(each['path']))}
            for each in json.loads(body)['files']]})

    def batch(self, body, name):
        self.repository(name, write=True)
        self.send(200, {'transfer': 'basic', 'objects': [
            {**each, 'actions': {'upload': {'href': f'{self.server.store}/{each["oid"]}'}}}
            for each in json.loads(body)['objects']]})

    def xet_token(self, body, name, kind, revision):
        self.repository(name, write=kind == 'write')
        where, until = f'local://{self.server.xet}', int(time.time()) + 3600
        self.send(200, {'casUrl': where, 'accessToken': 'short-lived', 'exp': until}, {
            'X-Xet-Cas-Url': where, 'X-Xet-Access-Token': 'short-lived',
            'X-Xet-Token-Expiration': until})

    def keep(self, body, oid):
        if _sha256(body) != oid:
            raise Refused(400, message='another SHA-256')
        self.server.large[oid] = body
        self.send(200)

    def commit(self, body, name, branch):
        repository, files = self.repository(name, write=True), {}
        for line in map(json.loads, body.splitlines()):
            value = line['value']
            if line['key'] == 'file':
                files[value['path']] = base64.b64decode(value['content'])
            elif line['key'] == 'lfsFile':
                files[value['path']] = self.server.large[value['oid']]
        commit = repository.commit(branch, files)
        self.send(200, {'commitUrl': f'{self.server.url}/{name}/commit/{commit}',
                        'commitOid': commit})

    def resolve(self, body, name, revision, path):
        repository, commit = self.commit_of(name, revision)
        data = repository.commits[commit].get(path)
        if data is None:
            raise Refused(404, 'EntryNotFound', 'Entry not found')
        headers = {'X-Repo-Commit': commit, 'ETag': f'"{_oid(data)}"'}
        if len(data) < LARGE:
            return self.send(200, data, headers)
        oid = _sha256(data)
        self.server.large[oid] = data
        if oid in self.server.xet_hashes:
            headers |= {'X-Xet-Hash': self.server.xet_hashes[oid], 'X-Xet-Refresh-Route':
                        f'{self.server.url}/api/models/{name}/xet-read-token/{commit}'}
        self.send(302, b'', headers | {
            'X-Linked-ETag': f'"{oid}"', 'X-Linked-Size': len(data),
            'Location': f'{self.server.store}/{oid}'})

    def give(self, body, oid):
        data = self.server.large[oid]
        begin = int(re.findall(r'bytes=(\d+)-', self.headers.get('Range', 'bytes=0-'))[0])
        headers = {'Content-Length': len(data) - begin, 'ETag': f'"{oid}"'}
        if begin:
            headers['Content-Range'] = f'bytes {begin}-{len(data) - 1}/{len(data)}'
        if not self.server.cuts and not self.server.stalls:
            return self.send(206 if begin else 200, data[begin:], headers)
        self.send(206 if begin else 200, data[begin:(begin + len(data)) // 2], headers)
        if self.server.stalls:
            self.server.stalled.set()
            self.server.ended.wait()
        self.server.cuts -= 1
        if self.server.dies:
            self.server.socket.close()
        self.close_connection = True

    def log_message(self, *arguments):
        """Say nothing."""


def _sha256(data):
    return hashlib.sha256(data).hexdigest()


def _oid(data):
    """Return the name that git gives a file, or that of its pointer; None: there is no file."""
    if data is None:
        return None
    if len(data) >= LARGE:
        return _sha256(data)
    return hashlib.sha1(b'blob %d\0' % len(data) + data).hexdigest()


_NAME = r'([\w.-]+/[\w.-]+)'
ROUTES = [
    ('POST', '/api/repos/create', Handler.create),
    ('POST', '/api/validate-yaml', Handler.validate),
    ('GET', f'/api/models/{_NAME}', Handler.info),
    ('GET', f'/api/models/{_NAME}/revision/(.+)', Handler.info),
    ('POST', f'/api/models/{_NAME}/branch/(.+)', Handler.branch),
    ('POST', f'/api/models/{_NAME}/preupload/(.+)', Handler.preupload),
    ('POST', f'/api/models/{_NAME}/commit/(.+)', Handler.commit),
    ('POST', rf'/{_NAME}\.git/info/lfs/objects/batch', Handler.batch),
    ('GET', f'/api/models/{_NAME}/xet-(read|write)-token/(.+)', Handler.xet_token),
    ('PUT', r'/store/(\w+)', Handler.keep),
    ('GET', r'/store/(\w+)', Handler.give),
    ('GET HEAD', f'/{_NAME}/resolve/([^/]+)/(.+)', Handler.resolve),
]

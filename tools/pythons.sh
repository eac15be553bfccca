#!/usr/bin/env bash
# Which Python, and how to get one; sourced by setup.sh and test_pythons.sh with $root set. The versions are the classifiers of setup.cfg.
versions=($(sed -n 's/.*Python :: \(3\.[0-9]*\)$/\1/p' "$root/setup.cfg"))
oldest=${versions[0]} newest=${versions[${#versions[@]} - 1]}

say() { printf 'sc3d set-up: %s\n' "$*" >&2; }

as_root() { # command; fails where root's rights are not to be had without a password
    if [ "$(id -u)" = 0 ]; then "$@"; else sudo -n true 2>/dev/null && sudo -n "$@"; fi
}

apt_install() { # packages; fails if apt may not be used here
    command -v apt-get >/dev/null && as_root apt-get update -qq &&
        as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@" >/dev/null
}

need() { # packages: install them, or say how and stop
    say "installing system packages: $*"
    apt_install "$@" || { say "please run: sudo apt-get install --no-install-recommends $*"; exit 1; }
}

fits() { # interpreter, versions
    "$1" -c 'import platform, sys, sysconfig
free_threaded = sysconfig.get_config_var("Py_GIL_DISABLED")
sys.exit(platform.python_implementation() != "CPython" or bool(free_threaded) or "%d.%d" % sys.version_info[:2] not in sys.argv[1:])' \
        "${@:2}" 2>/dev/null
}

version_of() { "$1" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null; }

python_of() { # version: the path of its interpreter, on the PATH or among those of uv and pyenv; fails if there is none
    local candidate
    for candidate in "python$1" "$(uv python find --system --no-python-downloads "$1" 2>/dev/null)" \
        "${PYENV_ROOT:-$HOME/.pyenv}/versions/$1".*/bin/python; do
        fits "$candidate" "$1" && { command -v "$candidate"; return; }
    done
    return 1
}

find_python() { # SC3D_PYTHON, else the system's own, else the newest that fits; fails if there is none
    local number
    if [ -n "${SC3D_PYTHON:-}" ]; then
        fits "$SC3D_PYTHON" "${versions[@]}" && { command -v "$SC3D_PYTHON"; return; }
        say "SC3D_PYTHON: $SC3D_PYTHON is no CPython $oldest to $newest"
        return 1
    fi
    fits python3 "${versions[@]}" && { command -v python3; return; }
    for ((number = ${#versions[@]} - 1; number >= 0; number--)); do
        python_of "${versions[number]}" && return
    done
    return 1
}

apt_python() { # the newest version that fits among the system's packages; fails if there is none
    local number
    command -v apt-cache >/dev/null || return 1
    as_root apt-get update -qq || true
    for ((number = ${#versions[@]} - 1; number >= 0; number--)); do
        apt-cache show "python${versions[number]}-venv" >/dev/null 2>&1 && { printf '%s' "${versions[number]}"; return; }
    done
    return 1
}

how_to_get() { # version: what a person types to get its interpreter
    local packaged
    if packaged=$(apt-cache show "python$1-venv" 2>/dev/null) && [ -n "$packaged" ]; then
        printf '  sudo apt-get install --no-install-recommends python%s-venv\n' "$1" >&2
    elif [ "$(uname -s)" = Darwin ]; then
        printf '  brew install python@%s\n' "$1" >&2
    fi
    printf '  curl -LsSf https://astral.sh/uv/install.sh | sh && ~/.local/bin/uv python install %s   # into the home folder\n' "$1" >&2
}

get_python() { # through apt, or say how and stop
    local version found
    [ -z "${SC3D_PYTHON:-}" ] || exit 1
    found=$(version_of python3) || found="not there"
    say "Python $oldest to $newest is needed; python3 is $found"
    version=$(apt_python) || version=
    if [ -n "$version" ]; then
        say "installing python$version-venv"
        apt_install "python$version-venv" && return
    fi
    say "one of these brings a Python that fits; then start again (or set SC3D_PYTHON to one):"
    how_to_get "${version:-$newest}"
    exit 1
}

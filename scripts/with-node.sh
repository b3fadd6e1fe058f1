#!/usr/bin/env bash
# Runs a command with a Node.js on PATH that is new enough for the portal's tools:
#   scripts/with-node.sh npm --prefix web_client run build
# The system's Node is taken when it is new enough, else the one in .venv (scripts/setup.sh installs it there).
set -euo pipefail
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)

# Keep in step with "engines" in web_client/package.json.
new_enough='const [major, minor] = process.versions.node.split(".").map(Number)
process.exit(major > 22 || (major === 22 && minor >= 12) ? 0 : 1)'

suitable() {
    command -v "$1/npm" >/dev/null && "$1/node" -e "$new_enough" 2>/dev/null
}

bundled=$root/.venv/node/bin
system=$(dirname "$(command -v node || echo /none/node)")
if suitable "$system"; then
    bin=$system
elif suitable "$bundled"; then
    bin=$bundled
else
    echo "There is no Node.js of version 22.12 or newer. Run 'make setup', which installs one into .venv." >&2
    exit 1
fi
PATH="$bin:$PATH"
# npm keeps downloads in the home directory; without a writable one it keeps them here.
if [ ! -w "${HOME:-/nonexistent}" ]; then
    export npm_config_cache="$root/.venv/npm-cache"
fi
export npm_config_update_notifier=false npm_config_fund=false npm_config_audit=false
exec "$@"

"""How the page of the API looks: as the portal does."""

STYLE = """
:root { color-scheme: dark; --bg: #0e1318; --bar: #121920; --card: #161e26; --raised: #1d2731; --line: #27323d;
  --text: #e3e9ee; --quiet: #93a1ae; --accent: #58c4d6; --good: #55c08a; --warn: #e3b052; --bad: #f0766f; }
* { box-sizing: border-box; }
html { scroll-padding-top: 4.5rem; }
body { margin: 0; background: var(--bg); color: var(--text);
  font: 0.9375rem/1.5 system-ui, -apple-system, 'Segoe UI', Roboto, 'Noto Sans', sans-serif; }
a { color: var(--accent); text-decoration: none; }
a:hover { text-decoration: underline; }
:focus-visible { outline: 2px solid var(--accent); outline-offset: 2px; border-radius: 4px; }
code { font-family: ui-monospace, 'Cascadia Mono', 'DejaVu Sans Mono', Menlo, monospace; font-size: 0.8125rem;
  color: #b8dfe6; overflow-wrap: anywhere; }
header { position: sticky; top: 0; z-index: 2; display: flex; align-items: center; gap: 0.6rem; min-height: 3.5rem;
  padding: 0.4rem 1.25rem; background: var(--bar); border-bottom: 1px solid var(--line); }
header h1 { margin: 0; font-size: 1rem; font-weight: 600; }
.brand { display: inline-flex; align-items: center; gap: 0.6rem; font-weight: 650; color: var(--text); }
.slash { color: #3a4855; }
.end { margin-left: auto; }
.plain { padding: 0.35rem 0.75rem; border: 1px solid var(--line); border-radius: 8px; background: var(--raised);
  color: var(--text); font-size: 0.875rem; }
.page { display: grid; grid-template-columns: 11rem minmax(0, 1fr); gap: 2rem; max-width: 1360px; margin: 0 auto;
  padding: 1.25rem; }
nav { position: sticky; top: 4.75rem; align-self: start; display: flex; flex-direction: column; gap: 0.1rem; }
nav a { padding: 0.3rem 0.7rem; border-radius: 8px; color: var(--quiet); white-space: nowrap; }
nav a:hover { background: var(--raised); color: var(--text); text-decoration: none; }
section { margin-bottom: 2.25rem; }
h2 { margin: 0 0 0.2rem; font-size: 1.25rem; font-weight: 650; }
h4 { margin: 1rem 0 0.3rem; font-size: 0.8125rem; font-weight: 600; color: var(--quiet); }
p { margin: 0 0 0.75rem; max-width: 70rem; }
small, .quiet { color: var(--quiet); }
.box { margin-bottom: 0.5rem; background: var(--card); border: 1px solid var(--line); border-radius: 12px; }
.box > table { margin: 0.3rem 0.9rem; width: calc(100% - 1.8rem); }
summary { display: flex; flex-wrap: wrap; align-items: baseline; gap: 0.3rem 0.8rem; padding: 0.55rem 0.9rem;
  cursor: pointer; list-style: none; border-radius: 12px; }
summary::-webkit-details-marker { display: none; }
summary:hover { background: var(--raised); }
.method { flex: none; width: 3.8rem; font: 650 0.75rem ui-monospace, 'DejaVu Sans Mono', monospace;
  color: var(--accent); }
.method.post { color: var(--good); }
.method.put { color: var(--warn); }
.method.delete { color: var(--bad); }
.path { color: var(--text); overflow-wrap: normal; }
.says { margin-left: auto; color: var(--quiet); text-align: right; }
.inside { padding: 0.6rem 0.9rem 0.4rem; border-top: 1px solid var(--line); }
table { width: 100%; border-collapse: collapse; }
td { padding: 0.35rem 0.8rem 0.35rem 0; border-top: 1px solid var(--line); vertical-align: top; }
tr:first-child td { border-top: 0; }
td:first-child { width: 13rem; }
td:last-child { padding-right: 0; }
b.good { color: var(--good); }
b.bad { color: var(--bad); }
@media (max-width: 760px) {
  header { padding-inline: 0.75rem; }
  .brand span, .slash { display: none; }
  .page { grid-template-columns: minmax(0, 1fr); gap: 1rem; padding: 0.75rem; }
  nav { position: static; flex-flow: row wrap; }
  nav a { padding: 0.2rem 0.6rem; background: var(--raised); font-size: 0.8125rem; }
  .says { margin-left: 0; width: 100%; text-align: left; }
  td { display: block; padding: 0.1rem 0; border-top: 0; }
  td:first-child { width: auto; padding-top: 0.5rem; }
  tr + tr td:first-child { border-top: 1px solid var(--line); }
}
"""

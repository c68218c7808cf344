"""How the page looks: one column of text, tables that scroll by themselves, light or dark as the reader's system is."""

from __future__ import annotations

CSS = """
:root { color-scheme: light dark; --ink:#1f2328; --dim:#5d6672; --paper:#fefefd; --soft:#f4f5f6; --rule:#d8dce1;
  --link:#0a62a3; --warn:#8a4b00; --warn-soft:#fff4e2; }
@media (prefers-color-scheme: dark) { :root { --ink:#e4e6e9; --dim:#9aa3ad; --paper:#15171a; --soft:#1e2125;
  --rule:#363b41; --link:#74b9ee; --warn:#f2b96a; --warn-soft:#2c2418; } }
* { box-sizing:border-box; }
html { scroll-padding-top:1rem; }
body { margin:0; background:var(--paper); color:var(--ink);
  font:15px/1.55 system-ui,-apple-system,"Segoe UI",Roboto,"Helvetica Neue",Arial,sans-serif; }
main, header, nav { max-width:76rem; margin:0 auto; padding:0 1.25rem; }
header { padding-top:2.2rem; }
h1 { font-size:1.75rem; line-height:1.2; margin:0 0 .5rem; letter-spacing:-.01em; }
h2 { font-size:1.3rem; line-height:1.25; margin:0 0 .75rem; padding-top:2.2rem; border-top:1px solid var(--rule); }
h3 { font-size:1.08rem; margin:2rem 0 .5rem; }
section { margin-top:2.4rem; }
p, ul { max-width:46rem; margin:.6rem 0; overflow-wrap:anywhere; }
ul { padding-left:1.2rem; }
a { color:var(--link); text-decoration:none; }
a:hover, a:focus-visible { text-decoration:underline; }
.note { color:var(--dim); font-size:.9rem; }
.warning { color:var(--warn); background:var(--warn-soft); border-left:3px solid currentColor;
  padding:.5rem .8rem; }
nav ul { list-style:none; display:flex; flex-wrap:wrap; gap:.2rem 1.1rem; max-width:none; padding:.7rem 0 0; }
figure { margin:1.3rem 0; }
figure .sheet, figure.table .sheet { overflow-x:auto; }
figcaption { color:var(--dim); font-size:.9rem; margin:.4rem 0; max-width:46rem; }
figure.table figcaption { color:var(--ink); font-weight:600; }
figure svg, figure img { display:block; max-width:100%; height:auto; color:var(--ink); }
table { border-collapse:collapse; font-size:.9rem; font-variant-numeric:tabular-nums; }
th, td { text-align:right; vertical-align:top; padding:.32rem .7rem; border-bottom:1px solid var(--rule);
  white-space:nowrap; }
thead th { font-weight:600; border-bottom:1.5px solid var(--dim); vertical-align:bottom; white-space:normal; }
thead th span { white-space:nowrap; }
tbody th { font-weight:500; }
.name { text-align:left; }
tbody tr:hover { background:var(--soft); }
td:first-child, th:first-child { padding-left:.1rem; }
.wide td, .wide tbody th { white-space:normal; font-weight:400; overflow-wrap:anywhere; min-width:9rem;
  max-width:34rem; }
.many th, .many td { padding-left:.25rem; padding-right:.5rem; }
td small { display:block; color:var(--dim); font-size:.82em; line-height:1.35; }
details { margin:.5rem 0; border:1px solid var(--rule); border-radius:4px; padding:.35rem .8rem; max-width:100%; }
details[open] { padding-bottom:.6rem; }
summary { cursor:pointer; overflow-wrap:anywhere; }
details details { border-width:0 0 1px; border-radius:0; padding-left:.2rem; }
footer { max-width:76rem; margin:3rem auto 0; padding:1rem 1.25rem 2.5rem; color:var(--dim); font-size:.85rem; }
@media print { details { border:0; } section { break-inside:auto; } figure { break-inside:avoid; } }
"""

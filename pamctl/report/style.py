"""The style of pages: wide and narrow screens, light, dark and in print.

The data colours are those of Okabe and Ito, which colour-blind readers can tell apart. On a dark
screen lighter colours replace the darker ones.
"""

COLOURS = """
:root{color-scheme:light dark;--bg:#fff;--fg:#1c2024;--dim:#5c6670;--rule:#dfe3e8;--panel:#f6f7f9;
--plot:#fff;--c0:#0072b2;--c1:#d55e00;--c2:#009e73;--c3:#cc79a7;--c4:#e69f00;--c5:#56b4e9;
--c6:#1c2024;--cm:#8a939c;--good:#00785a;--warn:#8a5a00;--bad:#c02d12}
@media(prefers-color-scheme:dark){:root{--bg:#14171a;--fg:#e4e7ea;--dim:#9aa4ae;--rule:#2e343a;
--panel:#1d2125;--plot:#191c20;--c0:#56b4e9;--c1:#f0803c;--c2:#1fc294;--c3:#dd93bb;--c4:#e6b84a;
--c5:#3f8fd0;--c6:#e4e7ea;--cm:#87919b;--good:#3fcf9f;--warn:#e6b84a;--bad:#ff8a6a}}
*{box-sizing:border-box}
body{margin:0;background:var(--bg);color:var(--fg);
font:15px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,"Helvetica Neue",Arial,sans-serif;
-webkit-text-size-adjust:100%}
"""
"""The colours and letters of every page; the live page has them too."""

_PAGE = """main{max-width:960px;margin:0 auto;padding:24px 20px 64px}
header{margin-bottom:14px}
h1{font-size:26px;line-height:1.2;margin:0 0 4px;overflow-wrap:anywhere}
h2{font-size:20px;margin:40px 0 10px;padding-top:10px;border-top:1px solid var(--rule)}
h3,h2:not([id]){font-size:16px;margin:24px 0 6px;padding:0;border:0}
p{margin:8px 0;max-width:75ch;overflow-wrap:anywhere}
ul{margin:8px 0;padding-left:22px;max-width:75ch}
.subtitle{color:var(--dim);margin:0}
nav{display:flex;flex-wrap:wrap;gap:4px 16px;margin:14px 0 0;font-size:14px}
a{color:var(--c0);text-decoration:none}a:hover{text-decoration:underline}
.callout{border-left:4px solid var(--cm);background:var(--panel);padding:8px 12px;max-width:none}
.callout.bad{border-color:var(--bad)}.callout.good{border-color:var(--good)}
.facts{display:grid;grid-template-columns:repeat(auto-fill,minmax(200px,1fr));gap:10px 20px;
margin:14px 0}
.facts dt{color:var(--dim);font-size:13px}.facts dd{margin:0;overflow-wrap:anywhere}
.wide{overflow-x:auto;margin:12px 0}
table{border-collapse:collapse;font-size:14px;font-variant-numeric:tabular-nums}
.caption{color:var(--dim);font-size:14px;margin:14px 0 0}.caption+.wide{margin-top:4px}
th,td{padding:4px 14px 4px 0;text-align:left;vertical-align:top;border-bottom:1px solid var(--rule)}
th{color:var(--dim);font-weight:600}.num{text-align:right;white-space:nowrap}
.short{white-space:nowrap}td:not(.num):not(.short){min-width:10em}
figure{margin:16px 0 24px}
figcaption{color:var(--dim);font-size:14px;margin-top:6px;max-width:85ch}
.plot{break-inside:avoid;margin-bottom:6px;min-width:0}
.ptitle{font-weight:600;font-size:14px;margin:6px 0 2px}
.ptitle .unit{color:var(--dim);font-weight:400;margin-left:6px}
.frame{padding:0 10px 0 56px}
.grid2{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,400px),1fr));gap:8px 24px}
.levels{display:grid;grid-template-columns:max-content 1fr max-content;gap:4px 10px;
align-items:center;font-size:14px}.levels svg{width:100%;height:15px}
svg{display:block;overflow:visible}
svg.open{overflow:visible}svg.data{overflow:hidden}
svg text{font-size:12px;fill:var(--dim)}
.paper{fill:var(--plot);stroke:var(--rule)}
.grid{stroke:var(--rule);stroke-width:1}
.yt{text-anchor:end}.xt{text-anchor:middle}.xl{text-anchor:end}
.note{fill:var(--fg);paint-order:stroke;stroke:var(--plot);stroke-width:3px}.note.end{text-anchor:end}.note.mid{text-anchor:middle}
.l,.p{fill:none;stroke:currentColor;stroke-width:1.3;stroke-linejoin:round;stroke-linecap:round;
vector-effect:non-scaling-stroke}
.l.thick{stroke-width:3}.l.mark{stroke-width:1.2;stroke-dasharray:6 4}
.p{stroke-width:3.2;opacity:.7}.p.few{stroke-width:6}
.b{fill:currentColor;opacity:.22;stroke:none}.b.solid{opacity:.75}.d{fill:currentColor}
.c0{color:var(--c0)}.c1{color:var(--c1)}.c2{color:var(--c2)}.c3{color:var(--c3)}
.c4{color:var(--c4)}.c5{color:var(--c5)}.c6{color:var(--c6)}.cm{color:var(--cm)}
.legend{list-style:none;display:flex;flex-wrap:wrap;gap:2px 16px;margin:0 0 2px;padding:0;
font-size:13px;color:var(--dim);max-width:none}
.legend li{display:flex;align-items:center;gap:6px;overflow-wrap:anywhere}
.swatch{width:22px;height:10px;flex:none}.shades{width:110px;height:10px}
.heat{display:inline-block;width:120px;height:10px}
details{margin:10px 0}summary{cursor:pointer;font-weight:600}
code{background:var(--panel);padding:1px 4px;font-size:13px;white-space:nowrap}
pre{overflow-x:auto;background:var(--panel);padding:10px 12px;font-size:12.5px;line-height:1.4}
@media(max-width:600px){main{padding:16px 12px 48px}h1{font-size:22px}.frame{padding-left:50px}
.spare{display:none}code{white-space:normal}
nav{flex-wrap:nowrap;overflow-x:auto;white-space:nowrap;padding-bottom:6px}
td,th{padding-right:10px}td:first-child{overflow-wrap:anywhere;min-width:7em}.facts{grid-template-columns:repeat(2,minmax(0,1fr))}}
@media print{:root{color-scheme:light;--bg:#fff;--fg:#000;--dim:#444;--rule:#ccc;--panel:#f6f6f6;
--plot:#fff;--c0:#0072b2;--c1:#d55e00;--c2:#009e73;--c3:#cc79a7;--c4:#e69f00;--c5:#56b4e9;
--c6:#000;--cm:#777;--good:#00785a;--bad:#c02d12}
body{font-size:10.5pt}main{max-width:none;padding:0}nav{display:none}
h2,h3{break-after:avoid}.callout,tr{break-inside:avoid}
details::details-content{content-visibility:visible;display:block;height:auto}
pre{white-space:pre-wrap}.wide{overflow:visible}@page{margin:14mm}}
"""
STYLE = COLOURS + _PAGE
"""The style sheet of all written pages."""

"""A page in a real browser: Chromium without a window.

Only the browser is needed: it prints the page after a script of the test has operated it.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from html import unescape
from pathlib import Path
from typing import Any

__all__ = ["BROWSER", "after"]

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--force-prefers-reduced-motion",
    "--virtual-time-budget=30000",
    "--dump-dom",
)


def after(page: Path, script: str, width: int = 1100) -> Any:
    """Return the value of a script that runs after the page has loaded; it may use `await` and must `return`.

    The security policy of the page permits only its own two scripts, so the policy is removed from the tested
    copy.
    """
    html = page.read_text("utf-8")
    policy = re.search(r'<meta http-equiv="Content-Security-Policy"[^>]*>', html)
    assert policy
    # Timers instead of frames: a busy machine may draw no frame before the browser's time limit.
    said = f"""<pre id=said></pre><script>
      requestAnimationFrame = (draw) => setTimeout(draw, 16);
      const {{ getContext }} = HTMLCanvasElement.prototype;
      HTMLCanvasElement.prototype.getContext = function (kind, options) {{
        return getContext.call(this, kind, {{ ...options, preserveDrawingBuffer: true }});
      }};
      const tell = (value) => {{ said.textContent = said.textContent || JSON.stringify(value); }};
      addEventListener("error", (event) => tell({{ error: event.message }}));
      addEventListener("load", () => setTimeout(() => (async () => {{ {script} }})().then(tell), 500));
    </script>"""
    copy = page.with_name("tested.html")
    copy.write_text(html.replace(policy[0], "").replace("<body>", f"<body>{said}", 1), "utf-8")
    profile = page.parent / "browser"
    command = [BROWSER, *FLAGS, f"--user-data-dir={profile}", f"--window-size={width},1200", copy.as_uri()]
    dumped = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout
    found = re.search(r'<pre id="said">(.*?)</pre>', dumped, re.DOTALL)
    assert found, dumped[:500]
    assert found[1], "the script said nothing"
    return json.loads(unescape(found[1]))

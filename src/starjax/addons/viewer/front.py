"""The document of the page: viser's, with our title, the system's colours, and a folded panel.

viser has no setting for these. Its page reads `?darkMode` from its address; on a narrow screen its
panel begins unfolded over the scene, and folds by a click on its head.
"""

import gzip
from typing import Any

_TITLE = b"<title>Viser</title>"
_NARROW = 600  # pixels
_HEAD = f"""<title>starjax</title>
<style>
@media (max-width: {_NARROW}px) {{ [style*="width: 20em"] {{ width: 100% !important; }} }}
</style>
<script>
if (matchMedia("(prefers-color-scheme: dark)").matches && !location.search.includes("darkMode"))
  history.replaceState(null, "", (location.search ? location.search + "&" : "?") + "darkMode");
if (innerWidth <= {_NARROW}) {{
  const watch = new MutationObserver(() => {{
    const panel = document.querySelector('[style*="max-height: 60%"] [style*="cursor: pointer"]');
    if (panel) {{ watch.disconnect(); panel.click(); }}
  }});
  watch.observe(document, {{ childList: true, subtree: true }});
}}
</script>
""".encode()


def adapt(response: Any) -> Any:
    """Changes the response with viser's document in place; returns it, and others as they are."""
    headers = response.headers
    if response.status_code != 200 or "text/html" not in headers.get("Content-Type", ""):
        return response
    is_packed = headers.get("Content-Encoding") == "gzip"
    body = gzip.decompress(response.body) if is_packed else response.body
    body = body.replace(_TITLE, _HEAD, 1)
    response.body = gzip.compress(body, 1) if is_packed else body
    del headers["Content-Length"]
    headers["Content-Length"] = str(len(response.body))
    return response

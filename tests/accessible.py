"""Checks of a page in Chromium, by the accessibility tree that screen readers get, the order in
which the Tab key goes through it, and the contrast of its text (WCAG 2.2).
"""

from pathlib import Path

NEED_NAMES = {"button", "link", "combobox", "slider", "textbox", "checkbox", "image", "dialog",
              "spinbutton", "listbox", "radio", "table", "switch"}  # fmt: skip

NO_WORK = {"listitem", "generic", "LabelText", "paragraph", "none", "row", "cell", "heading"}
"""What is only read, and so need not be reached by the Tab key."""

SCRIPTS = Path(__file__).with_name("accessible.js").read_text().split("// ---\n")
PROBLEMS, CONTRAST, FOCUS = SCRIPTS


def unnamed(page):
    """What a screen reader meets that has a role but no name, by Chromium's own tree."""
    session = page.context.new_cdp_session(page)
    nodes = session.send("Accessibility.getFullAXTree")["nodes"]
    found = []
    for node in nodes:
        role = node.get("role", {}).get("value")
        if node.get("ignored"):
            continue
        reached = any(
            p["name"] == "focusable" and p["value"]["value"] for p in node.get("properties", ())
        )
        if reached and role in NO_WORK:
            about = session.send("DOM.describeNode", {"backendNodeId": node["backendDOMNodeId"]})
            found.append(f"the Tab key reaches a {role}: {about['node'].get('attributes')}")
        if role not in NEED_NAMES:
            continue
        if not node.get("name", {}).get("value", "").strip():
            about = session.send("DOM.describeNode", {"backendNodeId": node["backendDOMNodeId"]})
            found.append(f"{role} without a name: {about['node'].get('attributes')}")
    return found, {n.get("role", {}).get("value") for n in nodes}


def tab_order(page, most=60):
    """What the Tab key reaches, in its order."""
    order = []
    for _ in range(most):
        page.keyboard.press("Tab")
        at = page.evaluate(FOCUS)
        if at is None or (order and at["at"] == order[0]["at"]):
            break
        order.append(at)
    return order


def problems(page):
    """Everything that is wrong, as sentences."""
    missing, _ = unnamed(page)
    return missing + page.evaluate(PROBLEMS) + page.evaluate(CONTRAST)

# Copyright 2026 The tap_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A real browser for pages, where one is installed."""

from contextlib import contextmanager
import shutil

import pytest

BROWSER = next(filter(None, map(shutil.which, (
    'chromium', 'chromium-browser', 'google-chrome', 'chromium-headless-shell'))), None)
needs_browser = pytest.mark.skipif(BROWSER is None, reason='no Chromium is installed')


@contextmanager
def chromium():
    """Start a browser."""
    playwright = pytest.importorskip('playwright.sync_api')
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=BROWSER, args=['--no-sandbox'])
        yield browser
        browser.close()


@contextmanager
def opened(browser, url, size=(1280, 800), **options):
    """Open a page; fail for what its script complains about."""
    # Waiting for an expression evaluates text, which the page's policy forbids.
    page, wrong = browser.new_page(
        viewport=dict(zip(('width', 'height'), size)), bypass_csp=True, **options), []
    page.on('pageerror', lambda error: wrong.append(str(error)))
    page.on('console', lambda line: line.type == 'error' and wrong.append(line.text))
    page.goto(url)
    yield page
    page.close()
    assert not wrong


def hidden_or_over(page, *selectors):
    """Return which of these are not wholly in sight or lie over another; a sideways scroll."""
    return page.evaluate("""(selectors) => {
        const boxes = selectors.map((one) => document.querySelector(one).getBoundingClientRect());
        const wrong = selectors.filter((_, k) => !boxes[k].height || boxes[k].top < 0
            || boxes[k].left < 0 || boxes[k].bottom > innerHeight || boxes[k].right > innerWidth);
        boxes.forEach((a, k) => boxes.slice(k + 1).forEach((b, n) => {
            if (a.left < b.right - 1 && b.left < a.right - 1 && a.top < b.bottom - 1
                && b.top < a.bottom - 1) wrong.push(`${selectors[k]}, ${selectors[k + 1 + n]}`);
        }));
        if (document.documentElement.scrollWidth > innerWidth) wrong.push('scrolls sideways');
        return wrong;
    }""", list(selectors))

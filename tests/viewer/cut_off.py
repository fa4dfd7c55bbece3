"""What of the page's text is cut off, lies outside of its panel or the window, or can hardly be read."""

from playwright.sync_api import Page

_FIND = """() => {
    const found = [];
    // Labels of buttons that show an icon are for screen readers alone.
    const unseen = (one) => getComputedStyle(one).clipPath !== 'none' && one.clientWidth <= 1;
    const shown = (one) =>
        one.getClientRects().length > 0 && getComputedStyle(one).visibility !== 'hidden' && !unseen(one);
    const clipped = (one) => {
        for (let box = one.parentElement; box; box = box.parentElement) {
            // A panel that scrolls shows everything sooner or later, but only up and down.
            if (!/hidden|clip|auto|scroll/.test(getComputedStyle(box).overflowX)) continue;
            const [own, its] = [one.getBoundingClientRect(), box.getBoundingClientRect()];
            if (own.left < its.left - 1.5 || own.right > its.right + 1.5) return true;
        }
        return false;
    };
    const text = (one) => (one.value ?? one.textContent).trim().slice(0, 40);
    const places =
        'label, button, .mantine-Button-label, th, td, input, select, output, [role=tab],' +
        ' .carts-caption, .carts-verdict, .carts-key';
    for (const one of document.querySelectorAll(places)) {
        if (!shown(one) || !text(one) || one.closest('.carts-document')) continue;
        const style = getComputedStyle(one);
        const hides = one.matches('input') || style.overflowX !== 'visible';
        const say = (problem) => found.push(`${one.tagName} ${text(one)}: ${problem}`);
        if (hides && one.scrollWidth > one.clientWidth + 1) say('too narrow');
        else if (one.clientWidth && one.scrollWidth > one.clientWidth + 3) say('text outside of its box');
        else if (clipped(one)) say('outside of what holds it');
        const box = one.getBoundingClientRect();
        if (box.left < -1 || box.right > innerWidth + 1) say('outside of the window');
    }
    for (const one of document.querySelectorAll('.carts-cell-label')) {
        const cell = one.parentElement.querySelector('.carts-cell').getBoundingClientRect();
        if (one.getBoundingClientRect().right > cell.right) found.push(`${text(one)}: outside of its picture`);
    }
    return found;
}"""


def cut_off(page: Page) -> list[str]:
    """Texts that are not wholly seen, each with the reason."""
    return page.evaluate(_FIND)


_CONTRAST = """(least) => {
    const parse = (text) => {
        const numbers = text.match(/[\\d.]+/g)?.map(Number) ?? [0, 0, 0, 0];
        return [numbers[0], numbers[1], numbers[2], numbers[3] ?? 1];
    };
    const over = ([r, g, b, a], below) => [r, g, b].map((value, i) => a * value + (1 - a) * below[i]);
    const behind = (one) => {
        const layers = [];
        for (let box = one; box; box = box.parentElement) layers.push(parse(getComputedStyle(box).backgroundColor));
        const light = document.documentElement.dataset.mantineColorScheme === 'light';
        return layers.reverse().reduce((below, layer) => over(layer, below), light ? [255, 255, 255] : [26, 27, 30]);
    };
    const luminance = (rgb) => {
        const [r, g, b] = rgb.map((value) => {
            const share = value / 255;
            return share <= 0.03928 ? share / 12.92 : ((share + 0.055) / 1.055) ** 2.4;
        });
        return 0.2126 * r + 0.7152 * g + 0.0722 * b;
    };
    const found = [];
    const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
    while (walker.nextNode()) {
        const one = walker.currentNode.parentElement;
        if (!walker.currentNode.textContent.trim() || !one.getClientRects().length) continue;
        if (one.closest('svg, script, style, [disabled], [data-disabled], .carts-marks, dialog:not([open])')) continue;
        const background = behind(one);
        const ink = over(parse(getComputedStyle(one).color), background);
        const [low, high] = [luminance(ink), luminance(background)].sort((a, b) => a - b);
        const contrast = (high + 0.05) / (low + 0.05);
        if (contrast < least) found.push(`${one.textContent.trim().slice(0, 40)}: ${contrast.toFixed(1)}`);
    }
    return found;
}"""


def hardly_legible(page: Page, least: float = 3.0) -> list[str]:
    """Texts whose contrast with what lies behind them is below this ratio (WCAG's definition)."""
    return page.evaluate(_CONTRAST, least)

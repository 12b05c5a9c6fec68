// What every state of the page is held against.
import { readFileSync } from 'node:fs';
import { createRequire } from 'node:module';
import type { Page } from 'playwright-core';

const AXE = readFileSync(createRequire(import.meta.url).resolve('axe-core/axe.min.js'), 'utf8');

interface Result {
  violations: { id: string; nodes: { html: string; failureSummary: string }[] }[];
}

/** Says what breaks WCAG 2.2 A or AA or good practice. */
export async function violations(page: Page): Promise<string[]> {
  // The page's policy lets no inline script run; the protocol's evaluation is not the page's.
  await page.evaluate(AXE);
  const result = await page.evaluate(
    () =>
      (globalThis as unknown as { axe: { run(): Promise<unknown> } }).axe.run() as Promise<unknown>,
  );
  return (result as Result).violations.flatMap((found) =>
    found.nodes.map((node) => `${found.id}: ${node.html} ${node.failureSummary}`),
  );
}

/** Names of what reaches beyond the panel, or beyond the card that it is in. */
export const overflowing = (page: Page) =>
  page.evaluate(() => {
    const beyond = (inner: Element, outer: Element) =>
      inner.getBoundingClientRect().right > outer.getBoundingClientRect().right + 0.5;
    const panel = document.querySelector('#panel');
    if (!panel) throw new Error('there is no panel');
    const found = [...panel.querySelectorAll('input, select, button, label, p, dd')].filter((element) => {
      const card = element.parentElement?.closest('.card') ?? panel;
      return element.getBoundingClientRect().width > 0 && (beyond(element, card) || beyond(element, panel));
    });
    return found.map((element) => `${element.tagName} ${element.textContent?.trim().slice(0, 30)}`);
  });

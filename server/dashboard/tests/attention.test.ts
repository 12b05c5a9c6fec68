// New alerts call whoever does not look: in the title of the tab, by a sound, and by a notification.
import type { Page } from 'playwright-core';
import { expect, test } from 'vitest';
import { browser, eventually } from './harness';

const { open } = browser();

interface Calls {
  source: EventSource;
  tones: number;
  notices: { title: string; body: string; onclick: (() => void) | null }[];
  permission: NotificationPermission;
}

/** Notes what sounds and what is notified; `permission` is what whoever is asked answers. */
async function watchCalls(page: Page, permission: NotificationPermission): Promise<void> {
  await page.addInitScript((permission) => {
    const calls: Partial<Calls> = { tones: 0, notices: [], permission: 'default' };
    class Source extends EventSource {
      constructor(...words: ConstructorParameters<typeof EventSource>) {
        super(...words);
        calls.source = this;
        // Alerts of the demo's robots come and go when they like: here there are those of the test alone.
        this.addEventListener('alert', (event) => event.isTrusted && event.stopImmediatePropagation());
      }
    }
    class Notice {
      static get permission() {
        return calls.permission;
      }
      static async requestPermission() {
        return (calls.permission = permission);
      }
      onclick: (() => void) | null = null;
      readonly body: string;
      constructor(
        readonly title: string,
        { body }: { body: string },
      ) {
        this.body = body;
        calls.notices?.push(this);
      }
      close() {}
    }
    const start = OscillatorNode.prototype.start;
    OscillatorNode.prototype.start = function (...words) {
      calls.tones = (calls.tones ?? 0) + 1;
      start.apply(this, words);
    };
    // As if another window were in front.
    document.hasFocus = () => false;
    Object.assign(globalThis, { EventSource: Source, Notification: Notice, calls });
  }, permission);
}

const calls = (page: Page) =>
  page.evaluate(() => {
    const { tones, notices } = (globalThis as unknown as { calls: Calls }).calls;
    return { tones, notices: notices.map(({ title, body }) => ({ title, body })) };
  });

/** The stream says something of an alert. */
const say = (page: Page, number: number, change: object = {}) =>
  page.evaluate(
    ({ number, change }) => {
      const id = `0192f0c1-2b3c-7d4e-8f50-00000000000${number}`;
      const said = { id, site: 'yard', robot: 'rover-2', code: 'robot-lost', severity: 'warning', text: `alert ${number}` };
      const times = { raised_at: '2026-01-31T14:05:09Z', acknowledged_at: null, cleared_at: null };
      const data = JSON.stringify({ alert: { ...said, ...times, ...change } });
      (globalThis as unknown as { calls: Calls }).calls.source.dispatchEvent(new MessageEvent('alert', { data }));
    },
    { number, change },
  );

test('new alerts are counted in the title, sound, and are notified', async () => {
  const page = await open({ prepare: (page) => watchCalls(page, 'granted') });
  const before = Number(/^\((\d+)\)/.exec(await page.title())?.[1] ?? 0);
  const titled = (more: number) =>
    eventually(`${more} more in the title`, async () => (await page.title()) === (before + more > 0 ? `(${before + more}) Tread` : 'Tread'));
  await say(page, 1);
  await titled(1);
  await page.waitForTimeout(800);
  expect(await calls(page), 'nothing unless it is wanted').toEqual({ tones: 0, notices: [] });

  await page.getByRole('tab', { name: 'Alerts' }).click();
  await page.getByLabel('Sound for new alerts').check();
  expect((await calls(page)).tones, 'it is heard when it is turned on').toBe(1);
  await page.getByLabel('Notification while').check();
  await page.getByRole('tab', { name: 'Robots' }).click();
  await say(page, 2);
  await titled(2);
  await eventually('a notification', async () => (await calls(page)).notices.length === 1);
  expect(await calls(page)).toEqual({ tones: 2, notices: [{ title: 'Tread: rover-2: No contact with the robot', body: 'Nothing has arrived from rover-2 for at least 15 s. alert 2' }] });
  // What was said before calls nobody again.
  await say(page, 2);
  await say(page, 1, { acknowledged_at: '2026-01-31T14:06:00Z' });
  await titled(1);
  await say(page, 2, { cleared_at: '2026-01-31T14:06:00Z' });
  await titled(0);
  // Several at once are one call, in the words of the worst.
  await say(page, 3);
  await say(page, 4, { severity: 'critical' });
  await eventually('another one', async () => (await calls(page)).notices.length === 2);
  expect(await calls(page)).toMatchObject({ tones: 5, notices: [{}, { title: 'Tread: 2 new alerts', body: 'Nothing has arrived from rover-2 for at least 15 s. alert 4' }] });
  await page.evaluate(() => (globalThis as unknown as { calls: Calls }).calls.notices[1]?.onclick?.());
  await eventually('the alerts', async () => (await page.getByRole('tab', { name: 'Alerts' }).getAttribute('aria-selected')) === 'true');
});

test('a browser that refuses notifications is said', async () => {
  const page = await open({ prepare: (page) => watchCalls(page, 'denied') });
  await page.getByRole('tab', { name: 'Alerts' }).click();
  await page.getByLabel('Notification while').click();
  await page.getByText('does not allow notifications').waitFor();
  expect(await page.getByLabel('Notification while').isChecked()).toBe(false);
});

// Several sites: the page of one site shows the alerts of the others.
import { afterAll, beforeAll, expect, test } from 'vitest';
import type { Alert, Page as ApiPage, Stop } from './types';
import { violations } from './checks';
import { browser, eventually, shot } from './harness';
import { type OwnServer, ownServer } from './own_server';

const { open } = browser();
let own: OwnServer;

beforeAll(async () => {
  own = await ownServer();
  await own.api('/v1/sites', 'POST', { id: 'quarry', name: 'Quarry' });
  await own.robot('yard', 'rover-1');
  await own.robot('quarry', 'digger-1');
  await own.api('/v1/sites/quarry/robots/digger-1', 'PATCH', { name: 'Big digger' });
});
afterAll(() => own.end());

const stop = (site: string, robot: string) => own.api<Stop>(`/v1/sites/${site}/robots/${robot}/stop`, 'POST', {});
const alertsOf = async (site: string) => (await own.api<ApiPage<Alert>>(`/v1/alerts?site=${site}&raised=true&kind=stopped`)).items;

async function clear(site: string, robot: string, { id }: Stop): Promise<void> {
  await eventually(`${robot} is cleared`, async () => {
    await own.api(`/v1/sites/${site}/robots/${robot}/stop/clear`, 'POST', { stop: id }).catch(() => undefined);
    return (await alertsOf(site)).length === 0;
  });
}

test('an alert of another site is counted, listed with its site, and leads there', async () => {
  const page = await open({ as: null, address: `${own.address}/#site=yard` });
  await page.getByLabel('Token').fill(own.token);
  await page.getByRole('button', { name: 'Sign in' }).click();
  await page.locator('button[data-robot="rover-1"]').waitFor();
  const titled = (title: string) => eventually(`the title ${title}`, async () => (await page.title()) === title);
  await titled('Tread');
  const stopped = await stop('quarry', 'digger-1');
  await titled('(1) Tread');
  const alert = await eventually('the alert', async () => (await alertsOf('quarry'))[0]);
  await page.getByRole('tab', { name: 'Alerts' }).click();
  const card = page.locator(`[data-alert="${alert.id}"]`);
  await card.getByText('Robot is stopped', { exact: true }).waitFor();
  await card.getByText('Quarry', { exact: true }).waitFor();
  expect(await violations(page), 'an alert of another site').toEqual([]);
  await shot(page, 'sites-alerts');
  // What is of the other site alone can be shown alone.
  const site = page.getByRole('combobox', { name: 'Site', exact: true }).last();
  await site.selectOption('yard');
  await page.getByText('No alert fits the filter.').waitFor();
  await site.selectOption('quarry');
  await card.getByRole('button', { name: 'Open digger-1' }).click();
  await page.getByRole('heading', { name: 'Big digger' }).waitFor();
  await eventually('the address of the other site', async () => page.url().includes('site=quarry'));
  await page.getByText(/^Big digger: stopped by .+\. The robot stands still\.$/).waitFor();
  await titled('(1) Tread');
  // Acknowledged there, it is no longer counted anywhere.
  await page.getByRole('tab', { name: 'Alerts' }).click();
  await card.getByRole('button', { name: 'Acknowledge' }).click();
  await titled('Tread');
  await clear('quarry', 'digger-1', stopped);
  await card.waitFor({ state: 'detached' });
});

test('an address that names an alert shows and marks it, whether it stands or is over', async () => {
  const stopped = await stop('quarry', 'digger-1');
  const alert = await eventually('the alert', async () => (await alertsOf('quarry'))[0]);
  const address = `${own.address}/#site=quarry&tab=alerts&alert=${alert.id}`;
  const look = async () => {
    const page = await open({ as: null, address });
    await page.getByLabel('Token').fill(own.token);
    await page.getByRole('button', { name: 'Sign in' }).click();
    const card = page.locator(`[data-alert="${alert.id}"][aria-current="true"]`);
    await card.getByText('Robot is stopped', { exact: true }).waitFor();
    return { page, card };
  };
  const standing = await look();
  await standing.card.getByText('since').waitFor();
  expect(await violations(standing.page), 'a marked alert').toEqual([]);
  await shot(standing.page, 'alert-marked');
  await clear('quarry', 'digger-1', stopped);
  const over = await look();
  expect(await over.card.locator('time').count(), 'when it began and ended').toBe(2);
  // Another address of the same kind, put into the same page.
  const next = await stop('yard', 'rover-1');
  const other = await eventually('another alert', async () => (await alertsOf('yard'))[0]);
  await over.page.evaluate((hash) => (location.hash = hash), `#site=yard&tab=alerts&alert=${other.id}`);
  await over.page.locator(`[data-alert="${other.id}"][aria-current="true"]`).waitFor();
  await clear('yard', 'rover-1', next);
  const none = await open({ as: null, address: `${own.address}/#site=yard&tab=alerts&alert=0192f0c1-2b3c-7d4e-8f50-6172839400aa`, expected: /404/ });
  await none.getByLabel('Token').fill(own.token);
  await none.getByRole('button', { name: 'Sign in' }).click();
  await none.locator('#panel .problem').waitFor();
});

test('an address of another site that is put into the page is opened by a reload', async () => {
  const page = await open({ as: null, address: `${own.address}/#site=yard` });
  await page.getByLabel('Token').fill(own.token);
  await page.getByRole('button', { name: 'Sign in' }).click();
  await page.locator('button[data-robot="rover-1"]').click();
  await eventually('the robot in the address', async () => page.url().includes('robot=rover-1'));
  await page.evaluate(() => {
    location.hash = '#site=quarry&robot=digger-1';
    location.reload();
  });
  await page.getByRole('heading', { name: 'Big digger' }).waitFor();
});

test('all alerts that are shown are acknowledged together', async () => {
  const both = [
    { site: 'yard', robot: 'rover-1', stop: await stop('yard', 'rover-1') },
    { site: 'quarry', robot: 'digger-1', stop: await stop('quarry', 'digger-1') },
  ];
  const page = await open({ as: null, address: `${own.address}/#site=yard&tab=alerts` });
  await page.getByLabel('Token').fill(own.token);
  await page.getByRole('button', { name: 'Sign in' }).click();
  await page.getByRole('button', { name: 'Acknowledge all 2 shown' }).click();
  await eventually('nothing is left to acknowledge', async () => (await page.title()) === 'Tread');
  for (const { site, robot, stop } of both) await clear(site, robot, stop);
});

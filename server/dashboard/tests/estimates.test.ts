// What a robot has found out of itself and its ground, and why it has no estimate.
import type { Page } from 'playwright-core';
import { expect, test } from 'vitest';
import type { ParameterEstimate, RobotLive } from './types';
import { violations } from './checks';
import { crowd } from './crowd';
import { browser, select, shot } from './harness';

const { open } = browser();

type Friction = NonNullable<RobotLive['friction']>['value'];
const ALL_WELL = { fault: 0, lost: 0, stopped: 0, moving: 0 };
const ROBOT = 'crowd-1';

const estimate = (value: number, std_dev: number, prior_dominated = false): ParameterEstimate => ({ value, std_dev, prior_dominated });

/** Opens the page with one robot selected, which says this of friction. */
async function openWith(friction: Friction): Promise<Page> {
  const page = await open({
    prepare: (page) =>
      crowd(page, 1, ALL_WELL, ({ live }) => {
        if (!live) throw new Error('the model says nothing');
        live.friction = { age_ms: 20, value: friction };
      }),
  });
  await select(page, ROBOT);
  return page;
}

const reason = (page: Page) => page.locator('[data-test="no-estimate"]');

/** The value beside a name in the robot's panel. */
const beside = (page: Page, name: string) => page.locator('dt', { hasText: name }).locator('xpath=following-sibling::dd[1]');

test('a robot without an estimate of θ says why, and which manoeuvre would help', async () => {
  const unknown: Friction = { theta_loop: null, theta_measured: null, excited: true, no_estimate: 'one_sided' };
  const page = await openWith(unknown);
  expect(await reason(page).innerText()).toBe('Nearly all turns were to one side. Turn to both sides, as in a figure-8.');
  expect(await violations(page)).toEqual([]);
  await shot(page, 'no-estimate');
});

test('nothing is asked for where there is an estimate', async () => {
  const theta_measured = { theta: 0.25, std_dev: 0.01 };
  const page = await openWith({ theta_loop: null, theta_measured, excited: true, no_estimate: null });
  expect(await beside(page, 'θ measured').innerText()).toContain('0.25');
  expect(await reason(page).count()).toBe(0);
});

test('parameters of the robot are shown with their intervals, and which of them the prior dominates', async () => {
  const page = await openWith({
    theta_loop: null,
    theta_measured: null,
    excited: true,
    no_estimate: 'short',
    robot_parameters: {
      apparent_mass_ratio: estimate(1.21, 0.01),
      mass_kg: estimate(20.4, 0.5, true),
      yaw_inertia_ratio: estimate(0.9, 0.05),
      center_of_mass_forward_m: estimate(0.012, 0.002),
      center_of_mass_left_m: estimate(-0.003, 0.001),
    },
  });
  expect(await beside(page, 'Apparent mass').innerText()).toBe('1.21 ± 0.02');
  const mass = await beside(page, 'Mass with payload').innerText();
  expect(mass).toMatch(/ ± .*\(mostly prior\)/);
  expect(await beside(page, 'Yaw inertia').innerText()).toBe('0.90 ± 0.10');
  expect(await beside(page, 'Centre of mass, left').innerText()).toMatch(/^-|^−/);
  await shot(page, 'robot-parameters');
});

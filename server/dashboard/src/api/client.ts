// Asks the server: one function, one kind of error.
import type { ProblemBody } from './schema';
import { withDetail, type Said } from '../message';
import { serverClock } from '../server_clock';
import { texts } from '../texts';

/** How long an answer may take, milliseconds; the server's own bound is 15 s. */
const ANSWER_MAX_MS = 16_000;
/** Entries of one page of a list, the most that the server gives. */
const PAGE_ENTRIES = 1_000;

/** What went wrong: one plain sentence, and what the server adds to it. */
export class Failure extends Error {
  readonly said: Said;

  constructor(message: string | Said) {
    const said = typeof message === 'string' ? () => message : message;
    super(said());
    this.said = said;
  }
}

/** What went wrong with a request. */
export class Problem extends Failure {
  constructor(
    message: string | Said,
    /** 0 when the server did not answer at all. */
    readonly status: number,
    readonly body: ProblemBody | null = null,
  ) {
    super(message);
  }

  get isLost(): boolean {
    return this.status === 0;
  }
}

/** One sentence for people about whatever was thrown, with what the server adds (`message.ts`). */
export function sentence(error: unknown): string {
  if (error instanceof Failure) return error.said();
  return error instanceof Error ? error.message : String(error);
}

/** The same for what is kept: the language may be another one when it is read. */
export function saidOf(error: unknown): Said {
  return () => sentence(error);
}

/** A sentence in the language of the page by the problem's type, with the server's own words after it. */
export function describe(body: ProblemBody): string {
  const title = texts.problem.title(body.type, body.title);
  return withDetail(`${title.charAt(0).toUpperCase()}${title.slice(1)}.`, body.detail);
}

export interface Asked {
  method?: 'GET' | 'POST' | 'PUT' | 'PATCH' | 'DELETE';
  body?: unknown;
  headers?: Record<string, string>;
  timeoutMs?: number;
}

/** Asks for `path`; throws a [`Problem`] unless the answer is a success. */
export async function ask<T>(path: string, asked: Asked = {}): Promise<T> {
  const headers: Record<string, string> = { ...asked.headers };
  const init: RequestInit = {
    method: asked.method ?? 'GET',
    headers,
    signal: AbortSignal.timeout(asked.timeoutMs ?? ANSWER_MAX_MS),
  };
  if (asked.body !== undefined) {
    headers['content-type'] = 'application/json';
    init.body = JSON.stringify(asked.body);
  }
  let response: Response;
  const sentAt = performance.now();
  try {
    response = await fetch(path, init);
    serverClock.heard(response.headers.get('date'), { sentAt, answeredAt: performance.now() });
  } catch {
    throw new Problem(() => texts.problem.lost, 0);
  }
  if (response.status === 204) return undefined as T;
  let body: unknown;
  try {
    body = await response.json();
  } catch {
    if (response.ok) throw new Problem(() => texts.problem.lost, 0);
    throw new Problem(() => texts.problem.unreadable(response.status), response.status);
  }
  if (response.ok) return body as T;
  const problem = body as ProblemBody;
  if (response.status === 401) {
    for (const listener of ended) listener();
  }
  throw new Problem(() => describe(problem), response.status, problem);
}

const ended = new Set<() => void>();

/** Calls when the server no longer knows who asks. */
export function whenSignedOut(listener: () => void): void {
  ended.add(listener);
}

export interface Listed<T> {
  items: T[];
  isWhole: boolean;
  /** The times that a list of the friction map states; null where it states none. */
  asOf: string | null;
  from: string | null;
}

/** Reads a list to its end, or to `most` entries. */
export async function list<T>(path: string, most: number): Promise<Listed<T>> {
  const items: T[] = [];
  let stated: { as_of?: string | null; from?: string | null } = {};
  let cursor: string | null = null;
  do {
    const query = new URLSearchParams({ limit: String(Math.min(PAGE_ENTRIES, most)) });
    if (cursor) query.set('cursor', cursor);
    const mark = path.includes('?') ? '&' : '?';
    const page: { items: T[]; next_cursor?: string | null; as_of?: string | null; from?: string | null } = await ask(`${path}${mark}${query}`);
    items.push(...page.items);
    stated = page;
    cursor = page.next_cursor ?? null;
  } while (cursor && items.length < most);
  return { items, isWhole: cursor === null, asOf: stated.as_of ?? null, from: stated.from ?? null };
}

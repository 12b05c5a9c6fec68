// The API's own types, for tests.
export type * from '../src/api/schema';

export interface Page<T> {
  items: T[];
  next_cursor?: string | null;
}

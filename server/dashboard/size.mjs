// Says how large the built page is when packed, and fails above the bound.
import { readFileSync, readdirSync } from 'node:fs';
import { gzipSync } from 'node:zlib';

const BOUND_KIB = 150;
const folder = new URL('dist/', import.meta.url);
let sum = 0;
for (const name of readdirSync(folder)) {
  const size = gzipSync(readFileSync(new URL(name, folder)), { level: 9 }).length;
  sum += size;
  console.log(`${name.padEnd(12)} ${(size / 1024).toFixed(1)} KiB packed`);
}
console.log(`page         ${(sum / 1024).toFixed(1)} KiB packed, at most ${BOUND_KIB}`);
process.exit(sum > BOUND_KIB * 1024 ? 1 : 0);

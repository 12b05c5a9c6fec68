// How the page is built: file names without hashes, because the server embeds and names them.
import { svelte } from '@sveltejs/vite-plugin-svelte';
import { defineConfig } from 'vite';

/** A server to develop against: `npm run dev`. */
const server = process.env['TREAD_SERVER'] ?? 'http://127.0.0.1:8420';

export default defineConfig(({ command }) => ({
  base: command === 'build' ? '/page/' : '/',
  plugins: [svelte()],
  build: {
    target: ['chrome123', 'firefox121', 'safari17.5'],
    assetsInlineLimit: 0,
    cssCodeSplit: false,
    modulePreload: false,
    reportCompressedSize: false,
    rollupOptions: {
      output: {
        entryFileNames: 'app.js',
        assetFileNames: 'app[extname]',
        codeSplitting: false,
      },
    },
  },
  server: {
    proxy: {
      '/v1': {
        target: server,
        ws: true,
        // The server lets its own page alone change something.
        headers: { origin: server, host: new URL(server).host },
      },
      '/readyz': server,
    },
  },
  test: { include: ['src/**/*.test.ts'] },
}));

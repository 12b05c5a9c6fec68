// An OpenID provider that is not ours (oidc-provider, certified by the OpenID Foundation), for the tests:
// people without passwords, chosen by `login_hint`. Each start has keys of its own.
import { createPrivateKey, generateKeyPairSync, randomUUID } from 'node:crypto';
import { readFileSync } from 'node:fs';
import { createServer } from 'node:http';
import { createServer as createTlsServer } from 'node:https';
import { join } from 'node:path';
import { pathToFileURL } from 'node:url';

const { port, packages, redirect, signedOut, algorithm, secret, groupsIn, certificate, key } = JSON.parse(
  process.argv[2],
);
const library = pathToFileURL(join(packages, 'node_modules/oidc-provider/lib/index.js'));
const { Provider } = await import(library.href);

const people = {
  anna: { name: 'anna', groups: ['operators', 'others'] },
  adam: { name: 'adam', groups: ['admins'] },
  bert: { name: 'bert', groups: ['viewers', 'operators'] },
  carl: { name: 'carl', groups: ['yard admins', 'viewers'] },
  eve: { name: 'eve', groups: ['others'] },
  tests: { name: 'tests', groups: ['viewers'] },
};

const isTls = certificate !== null;
const issuer = `${isTls ? 'https' : 'http'}://127.0.0.1:${port}`;
// By way of PEM: the export of a freshly made key object as JWK hangs in one start of twenty (Node.js 20),
// when the collector takes away what made it, which shares its lock.
const jwk = (type, options, alg) => {
  const privateKeyEncoding = { type: 'pkcs8', format: 'pem' };
  const publicKeyEncoding = { type: 'spki', format: 'pem' };
  const { privateKey } = generateKeyPairSync(type, { ...options, privateKeyEncoding, publicKeyEncoding });
  return { ...createPrivateKey(privateKey).export({ format: 'jwk' }), kid: randomUUID(), use: 'sig', alg };
};

const provider = new Provider(issuer, {
  clients: [
    {
      client_id: 'tread',
      ...(secret ? { client_secret: secret } : {}),
      token_endpoint_auth_method: secret ? 'client_secret_basic' : 'none',
      redirect_uris: [redirect],
      post_logout_redirect_uris: [signedOut],
      response_types: ['code'],
      grant_types: ['authorization_code'],
      id_token_signed_response_alg: algorithm,
    },
  ],
  jwks: { keys: [jwk('rsa', { modulusLength: 2048 }, 'RS256'), jwk('ec', { namedCurve: 'P-256' }, 'ES256')] },
  enabledJWA: { idTokenSigningAlgValues: ['RS256', 'ES256'] },
  // Either in the ID token, or at the user info endpoint alone.
  conformIdTokenClaims: groupsIn !== 'id_token',
  claims: {
    openid: ['sub'],
    profile: ['preferred_username'],
    email: ['email'],
    groups: ['groups', 'realm_access'],
  },
  pkce: { required: () => true },
  cookies: { keys: ['not a secret'] },
  features: {
    devInteractions: { enabled: false },
    rpInitiatedLogout: {
      enabled: true,
      logoutSource(ctx, form) {
        ctx.body = form;
      },
    },
  },
  findAccount: (_ctx, sub) => ({
    accountId: sub,
    claims: () => {
      const person = people[sub.replace(/^id-/, '')];
      return {
        sub,
        preferred_username: person.name,
        email: `${person.name}@example.org`,
        groups: person.groups,
        realm_access: { roles: person.groups },
      };
    },
  }),
  async loadExistingGrant(ctx) {
    const grant = new ctx.oidc.provider.Grant({
      clientId: ctx.oidc.client.clientId,
      accountId: ctx.oidc.session.accountId,
    });
    grant.addOIDCScope('openid profile email groups');
    await grant.save();
    return grant;
  },
  interactions: { url: (_ctx, interaction) => `/interaction/${interaction.uid}` },
  ttl: { AccessToken: 300, AuthorizationCode: 60, Grant: 600, IdToken: 300, Interaction: 600, Session: 600 },
});

const answer = provider.callback();
async function interact(request, response) {
  const { params } = await provider.interactionDetails(request, response);
  const who = params.login_hint;
  const result = who in people ? { login: { accountId: `id-${who}` } } : { error: 'access_denied' };
  await provider.interactionFinished(request, response, result, { mergeWithLastSubmission: false });
}
const listener = (request, response) => {
  if (!request.url.startsWith('/interaction/')) return answer(request, response);
  interact(request, response).catch((error) => response.writeHead(500).end(String(error)));
};
const server = isTls
  ? createTlsServer({ cert: readFileSync(certificate), key: readFileSync(key) }, listener)
  : createServer(listener);
server.listen(port, '127.0.0.1', () => console.log('ready'));

//! A provider that we did not write, as a process of its own on the loopback, and a browser without a
//! page that goes to and fro between it and the server.

use std::collections::HashMap;
use std::io::{BufRead as _, BufReader};
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use reqwest::{Response, StatusCode, Url, header, redirect};
use serde_json::json;

use crate::harness::{Yard, folder_of_the_crate};

/// Where the provider believes the server to be; browsers of the tests go to where it is.
pub(super) const PUBLIC: &str = "http://127.0.0.1:8420";

/// How a provider is to be.
#[derive(Debug, Clone)]
pub(super) struct Kind {
    pub(super) algorithm: &'static str,
    pub(super) secret: Option<&'static str>,
    pub(super) groups_in: &'static str,
    /// Certificate and key, PEM.
    pub(super) tls: Option<(PathBuf, PathBuf)>,
}

impl Default for Kind {
    fn default() -> Self {
        Self {
            algorithm: "RS256",
            secret: Some("s3cret"),
            groups_in: "id_token",
            tls: None,
        }
    }
}

/// How long the provider may take to start: it reads hundreds of files, which may be on a cold disk.
const START_MAX: Duration = Duration::from_secs(40);

/// A provider at work; its process ends with it.
pub(super) struct Provider {
    process: Child,
}

impl Provider {
    /// Starts one and waits until it listens.
    pub(super) async fn start(port: u16, kind: &Kind) -> Self {
        let cache = std::env::var_os("XDG_CACHE_HOME").map(PathBuf::from);
        let home = || PathBuf::from(std::env::var_os("HOME").unwrap()).join(".cache");
        let packages = cache.unwrap_or_else(home).join("tread/oidc-provider");
        assert!(
            packages.join("node_modules/oidc-provider").is_dir(),
            "the provider of server/tests/oidc is not installed: `./check` does it, or `npm ci \
             --ignore-scripts` with its two package files in {}",
            packages.display()
        );
        let (certificate, key) = kind.tls.clone().unzip();
        let asked = json!({
            "port": port, "packages": packages, "algorithm": kind.algorithm, "secret": kind.secret,
            "groupsIn": kind.groups_in, "certificate": certificate, "key": key,
            "redirect": format!("{PUBLIC}/v1/sign-in/oidc/callback"),
            "signedOut": format!("{PUBLIC}/"),
        });
        let script = folder_of_the_crate().join("tests/oidc/provider.mjs");
        let mut command = Command::new("node");
        command.arg(script).arg(asked.to_string());
        command.stdin(Stdio::null()).stderr(Stdio::null());
        let mut process = command.stdout(Stdio::piped()).spawn().unwrap();
        let said = BufReader::new(process.stdout.take().unwrap());
        let ready = tokio::task::spawn_blocking(move || {
            let mut lines = said.lines().map_while(Result::ok);
            lines.any(|line| line == "ready")
        });
        let provider = Self { process };
        let ready = tokio::time::timeout(START_MAX, ready).await;
        let ready = ready.expect("the provider starts");
        assert!(ready.unwrap(), "the provider has ended");
        provider
    }
}

impl Drop for Provider {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// A browser without a page: cookies, and redirects as far as the test asks.
pub(super) struct Browser {
    client: reqwest::Client,
    server: String,
    cookies: HashMap<String, HashMap<String, String>>,
}

impl Browser {
    pub(super) fn new(yard: &Yard) -> Self {
        Self::trusting(yard, None)
    }

    /// The same, which trusts an authority.
    pub(super) fn trusting(yard: &Yard, authority: Option<&[u8]>) -> Self {
        let _ = rustls::crypto::ring::default_provider().install_default();
        let authorities = authority.map(|pem| reqwest::Certificate::from_pem(pem).unwrap());
        let client = reqwest::Client::builder()
            .redirect(redirect::Policy::none())
            .tls_certs_only(authorities)
            .build();
        Self {
            client: client.unwrap(),
            server: yard.url(""),
            cookies: HashMap::new(),
        }
    }

    fn here(&self, url: &str) -> Url {
        let url = url
            .strip_prefix(PUBLIC)
            .map_or_else(|| url.to_owned(), |path| format!("{}{path}", self.server));
        let url = if url.starts_with('/') {
            format!("{}{url}", self.server)
        } else {
            url
        };
        url.parse().unwrap()
    }

    /// The value of a cookie of the server's.
    pub(super) fn cookie(&mut self, name: &str) -> Option<&mut String> {
        let origin = self.here("/").origin().ascii_serialization();
        self.cookies.get_mut(&origin)?.get_mut(name)
    }

    /// A request for a page of the server or the provider. The server is asked by the name that it has in
    /// public, as by a proxy.
    pub(super) fn asking(&self, url: &str) -> reqwest::RequestBuilder {
        let url = self.here(url);
        let is_server = url.as_str().starts_with(&self.server);
        let asked = self.client.get(url);
        match PUBLIC.strip_prefix("http://") {
            Some(host) if is_server => asked.header(header::HOST, host),
            _ => asked,
        }
    }

    /// A request for a path of the server, by another name of it.
    pub(super) fn asking_at(&self, host: &str, path: &str) -> reqwest::RequestBuilder {
        self.client.get(self.here(path)).header(header::HOST, host)
    }

    /// Asks for a page of the server or the provider.
    pub(super) async fn get(&mut self, url: &str) -> Response {
        let asked = self.asking(url);
        self.send(url, asked).await
    }

    /// Sends what it builds, with the cookies for there, and keeps those that come.
    pub(super) async fn send(&mut self, url: &str, asked: reqwest::RequestBuilder) -> Response {
        let origin = self.here(url).origin().ascii_serialization();
        let kept = self.cookies.entry(origin).or_default();
        let shown: Vec<String> = kept
            .iter()
            .map(|(name, value)| format!("{name}={value}"))
            .collect();
        let response = asked.header(header::COOKIE, shown.join("; ")).send();
        let response = response.await.unwrap();
        for given in response.headers().get_all(header::SET_COOKIE) {
            let pair = given.to_str().unwrap().split(';').next().unwrap();
            let (name, value) = pair.split_once('=').unwrap();
            if value.is_empty() {
                kept.remove(name);
            } else {
                kept.insert(name.to_owned(), value.to_owned());
            }
        }
        response
    }

    /// Asks the server to change something, as its page does.
    pub(super) async fn delete(&mut self, path: &str) -> Response {
        let asked = self.client.delete(self.here(path));
        let asked = asked.header("sec-fetch-site", "same-origin");
        self.send(path, asked).await
    }

    /// Sends a form to the provider.
    pub(super) async fn post(&mut self, url: &str, form: &str) -> Response {
        let asked = self.client.post(self.here(url)).body(form.to_owned());
        let asked = asked.header(header::CONTENT_TYPE, "application/x-www-form-urlencoded");
        self.send(url, asked).await
    }

    /// Begins a sign-in: where the browser is sent.
    pub(super) async fn begin(&mut self) -> Url {
        let begun = self.get("/v1/sign-in/oidc").await;
        assert_eq!(begun.status(), StatusCode::SEE_OTHER, "{begun:?}");
        location(&begun).parse().unwrap()
    }

    /// Signs in at the provider as somebody: where it sends the browser back to.
    pub(super) async fn at_provider(&mut self, mut url: Url, who: &str) -> String {
        url.query_pairs_mut().append_pair("login_hint", who);
        let mut next = url.to_string();
        // Signed in elsewhere before, this browser would be again.
        let origin = url.origin().ascii_serialization();
        self.cookies.remove(&origin);
        for _ in 0..10 {
            let answer = self.get(&next).await;
            assert!(answer.status().is_redirection(), "{next}: {answer:?}");
            next = url.join(&location(&answer)).unwrap().to_string();
            if next.starts_with(PUBLIC) {
                return next;
            }
        }
        panic!("the provider sends the browser round and round: {next}");
    }

    /// Signs in as somebody: the answer to the browser that comes back.
    pub(super) async fn sign_in(&mut self, who: &str) -> Response {
        let begun = self.begin().await;
        let back = self.at_provider(begun, who).await;
        self.get(&back).await
    }
}

pub(super) fn location(answer: &Response) -> String {
    let location = answer.headers()[header::LOCATION].to_str().unwrap();
    location.to_owned()
}

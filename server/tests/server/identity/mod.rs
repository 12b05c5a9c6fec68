//! Who may do what: the table of roles, tokens, browsers, the audit log, connections and TLS.

mod audit;
mod browsers;
mod connections;
mod matrix;
mod tls;
mod tokens;

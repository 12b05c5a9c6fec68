//! Who may do what: the table of roles, tokens, browsers, the audit log, connections, TLS, and joining robots.

mod audit;
mod browsers;
mod connections;
mod enrolment;
mod matrix;
mod tls;
mod tokens;

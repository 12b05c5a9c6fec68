//! Who may do what: the table of rights, tokens, browsers, the audit log, connections, TLS, and joining robots.

mod audit;
pub(crate) mod browsers;
mod connections;
mod enrolment;
mod every_route;
mod rights;
mod tls;
mod tokens;

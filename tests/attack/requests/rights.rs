//! Who may do what, as `docs/rest.md` and `docs/security.md` say it, and not as the code does.

/// What somebody must show.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Needs {
    Nothing,
    Viewer,
    Operator,
    Admin,
}

use Needs::{Admin, Nothing, Operator, Viewer};

/// Every operation but those that only read; those are a viewer's unless they stand here.
const TABLE: [(&str, &str, Needs); 57] = [
    ("GET", "/healthz", Nothing),
    ("GET", "/readyz", Nothing),
    ("POST", "/v1/session", Nothing),
    ("GET", "/v1/sign-in", Nothing),
    ("GET", "/v1/sign-in/oidc", Nothing),
    ("GET", "/v1/sign-in/oidc/callback", Nothing),
    ("POST", "/v1/enrolments", Nothing),
    ("POST", "/v1/enrolments/renew", Nothing),
    ("DELETE", "/v1/session", Viewer),
    ("POST", "/v1/stop", Viewer),
    ("POST", "/v1/sites/{site}/robots/{robot}/stop", Viewer),
    ("POST", "/v1/sites/{site}/friction/path", Viewer),
    ("POST", "/v1/alerts/{alert}/acknowledge", Operator),
    ("POST", "/v1/missions", Operator),
    ("POST", "/v1/missions/{mission}/cancel", Operator),
    ("POST", "/v1/missions/{mission}/pause", Operator),
    ("POST", "/v1/missions/{mission}/resume", Operator),
    ("POST", "/v1/missions/{mission}/replace", Operator),
    ("POST", "/v1/trajectories/check", Operator),
    ("PUT", "/v1/sites/{site}/geofence", Operator),
    ("PUT", "/v1/sites/{site}/origin", Operator),
    ("DELETE", "/v1/sites/{site}/origin", Operator),
    ("PATCH", "/v1/sites/{site}/robots/{robot}", Operator),
    (
        "PUT",
        "/v1/sites/{site}/robots/{robot}/limits/{owner}",
        Operator,
    ),
    (
        "DELETE",
        "/v1/sites/{site}/robots/{robot}/limits/{owner}",
        Operator,
    ),
    ("POST", "/v1/sites/{site}/robots/{robot}/release", Operator),
    (
        "POST",
        "/v1/sites/{site}/robots/{robot}/stop/clear",
        Operator,
    ),
    (
        "POST",
        "/v1/sites/{site}/robots/{robot}/withdrawals",
        Operator,
    ),
    ("POST", "/v1/sites/{site}/terrains", Operator),
    ("PUT", "/v1/sites/{site}/terrains/{terrain}", Operator),
    ("DELETE", "/v1/sites/{site}/terrains/{terrain}", Operator),
    ("POST", "/v1/authority/rotation", Admin),
    ("POST", "/v1/authority/rotation/finish", Admin),
    ("POST", "/v1/authority/replace", Admin),
    ("GET", "/v1/audit", Admin),
    ("GET", "/v1/audit/chain", Admin),
    ("GET", "/v1/tokens", Admin),
    ("POST", "/v1/tokens", Admin),
    ("DELETE", "/v1/tokens/{token}", Admin),
    ("GET", "/v1/sessions", Admin),
    ("DELETE", "/v1/sessions/{session}", Admin),
    ("GET", "/v1/join-tokens", Admin),
    ("POST", "/v1/join-tokens", Admin),
    ("DELETE", "/v1/join-tokens/{token}", Admin),
    ("POST", "/v1/sites", Admin),
    ("DELETE", "/v1/sites/{site}/enrolments/{robot}", Admin),
    ("GET", "/v1/webhooks", Admin),
    ("POST", "/v1/webhooks", Admin),
    ("GET", "/v1/webhooks/{webhook}", Admin),
    ("PUT", "/v1/webhooks/{webhook}", Admin),
    ("DELETE", "/v1/webhooks/{webhook}", Admin),
    ("POST", "/v1/webhooks/{webhook}/secret", Admin),
    ("POST", "/v1/webhooks/{webhook}/test", Admin),
    ("GET", "/v1/webhooks/{webhook}/deliveries", Admin),
    // What a viewer reads though the paths look like those of an admin.
    ("GET", "/v1/sites/{site}/enrolments", Viewer),
    ("GET", "/v1/session", Viewer),
    ("GET", "/v1/server", Viewer),
];

/// What an operation needs; `None` if nothing that is written says so.
pub(super) fn needs(method: &str, path: &str) -> Option<Needs> {
    let of = |row: &&(&str, &str, Needs)| row.0 == method && row.1 == path;
    let found = TABLE.iter().find(of).map(|row| row.2);
    found.or((method == "GET").then_some(Viewer))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_only_reads_is_a_viewers_and_a_change_that_is_not_written_down_is_nobodys() {
        assert_eq!(needs("GET", "/v1/missions"), Some(Viewer));
        assert_eq!(needs("GET", "/v1/audit"), Some(Admin));
        assert_eq!(needs("POST", "/v1/stop"), Some(Viewer));
        assert_eq!(needs("POST", "/v1/what"), None);
    }
}

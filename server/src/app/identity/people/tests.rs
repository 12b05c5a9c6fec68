use super::*;
use crate::app::identity::SESSION_LASTS;
use crate::config::oidc::SESSION_HOURS_RANGE;

#[test]
fn a_person_is_signed_in_for_no_longer_than_a_token() {
    let most = i64::from(*SESSION_HOURS_RANGE.end());
    assert_eq!(SignedDuration::from_hours(most), SESSION_LASTS);
}

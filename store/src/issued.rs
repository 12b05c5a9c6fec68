//! Tracks the certificates with which a robot may request a renewal: those signed by this server
//! that the robot may still hold. A certificate forged with a stolen authority key is not among
//! them and is refused.

use serde::{Deserialize, Serialize};

/// Maximum number of accepted certificates of a robot; beyond it the second oldest is dropped.
const ISSUED_MAX: usize = 16;

/// Fingerprints of a robot's certificates that are accepted for a renewal, oldest first: the one
/// presented at the last renewal, and those signed since, whose answers may be lost or late.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Issued(Vec<String>);

impl Issued {
    /// Returns the list of one certificate.
    pub fn one(fingerprint: String) -> Self {
        Self(vec![fingerprint])
    }

    /// Returns the list after a renewal, in which the robot presented `shown` and `next` was
    /// signed; `None` if `shown` is not accepted. Certificates older than `shown` are dropped.
    #[must_use]
    pub fn renewed(&self, shown: &str, next: String) -> Option<Self> {
        let at = self.0.iter().position(|one| one == shown)?;
        let mut left = self.0[at..].to_vec();
        if left.len() >= ISSUED_MAX {
            // The answer with the oldest certificate signed for `shown` will not arrive any more.
            left.remove(1);
        }
        left.push(next);
        Some(Self(left))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn what_was_not_signed_here_or_long_ago_does_not_count() {
        let issued = Issued::one("a".to_owned());
        assert_eq!(issued.renewed("forged", "b".to_owned()), None);
        let issued = issued.renewed("a", "b".to_owned()).unwrap();
        // The answer was lost, and the robot repeats its request.
        let issued = issued.renewed("a", "c".to_owned()).unwrap();
        let issued = issued.renewed("b", "d".to_owned()).unwrap();
        assert_eq!(issued.renewed("a", "e".to_owned()), None);
        assert_eq!(issued, Issued(vec!["b".into(), "c".into(), "d".into()]));
    }

    proptest! {
        /// A robot sends a request, repeats it after a timeout, and accepts the answer to its
        /// latest request only; requests arrive late and in any order, and answers are lost.
        #[test]
        fn whatever_is_lost_or_late_the_certificate_that_a_robot_has_counts(
            steps in prop::collection::vec((0_u8..3, any::<prop::sample::Index>()), 1..200),
        ) {
            let mut issued = Issued::one("0".to_owned());
            let mut held = "0".to_owned();
            let (mut asked, mut signed) = (0_u32, 0_u32);
            let mut on_the_way: Vec<(u32, String)> = Vec::new();
            let mut answers: Vec<(u32, String)> = Vec::new();
            for (what, which) in steps {
                match what {
                    // Few requests are in flight at a time, because robots back off.
                    0 if on_the_way.len() + answers.len() < ISSUED_MAX - 2 => {
                        asked += 1;
                        on_the_way.push((asked, held.clone()));
                    }
                    1 if !on_the_way.is_empty() => {
                        let (number, shown) = on_the_way.remove(which.index(on_the_way.len()));
                        signed += 1;
                        if let Some(renewed) = issued.renewed(&shown, signed.to_string()) {
                            issued = renewed;
                            answers.push((number, signed.to_string()));
                        }
                    }
                    2 if !answers.is_empty() => {
                        let (number, certificate) = answers.remove(which.index(answers.len()));
                        if number == asked {
                            held = certificate;
                        }
                    }
                    _ => {}
                }
                prop_assert!(issued.0.contains(&held), "{held} is not in {issued:?}");
                prop_assert!(issued.0.len() <= ISSUED_MAX);
            }
        }
    }
}

//! Liveliness tokens by router. A robot that moves to another router may appear there before its
//! token vanishes from the first; it then counts as present all the time.

use std::collections::{HashMap, HashSet, VecDeque};

/// Maximum number of tokens tracked: many runs of many robots.
const TOKENS_MAX: usize = 32_768;

/// Number of closed routers remembered; messages of a router arrive long before so many more close.
pub(super) const CLOSED_MAX: usize = 64;

/// The present tokens.
#[derive(Debug, Default)]
pub(super) struct Tokens {
    routers_of: HashMap<String, HashSet<u64>>,
    closed: VecDeque<u64>,
}

impl Tokens {
    /// Adds a token on a router. Returns whether it was on none before.
    pub(super) fn add(&mut self, token: &str, router: u64) -> bool {
        if self.closed.contains(&router) {
            // It was under way when the router closed, and would never be removed.
            return false;
        }
        if let Some(routers) = self.routers_of.get_mut(token) {
            routers.insert(router);
            return false;
        }
        if self.routers_of.len() >= TOKENS_MAX {
            return false;
        }
        self.routers_of
            .insert(token.to_owned(), HashSet::from([router]));
        true
    }

    /// Removes a token from a router. Returns whether it is on none now.
    pub(super) fn remove(&mut self, token: &str, router: u64) -> bool {
        let Some(routers) = self.routers_of.get_mut(token) else {
            return false;
        };
        routers.remove(&router);
        let is_nowhere = routers.is_empty();
        if is_nowhere {
            self.routers_of.remove(token);
        }
        is_nowhere
    }

    /// Removes a router. Returns the tokens that are on none now.
    pub(super) fn router_closed(&mut self, router: u64) -> Vec<String> {
        if self.closed.len() >= CLOSED_MAX {
            self.closed.pop_front();
        }
        self.closed.push_back(router);
        let held = self
            .routers_of
            .iter()
            .filter(|(_, routers)| routers.contains(&router));
        let held: Vec<String> = held.map(|(token, _)| token.clone()).collect();
        held.into_iter()
            .filter(|token| self.remove(token, router))
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn a_token_is_there_as_long_as_any_open_router_has_it(
            steps in prop::collection::vec((0_u8..3, 0_u8..3, 0_u64..3), 0..100),
        ) {
            let mut tokens = Tokens::default();
            let mut model: HashSet<(String, u64)> = HashSet::new();
            let mut closed: HashSet<u64> = HashSet::new();
            for (what, token, router) in steps {
                let token = token.to_string();
                let is_closed = |closed: &HashSet<u64>| closed.contains(&router);
                let is_there = |model: &HashSet<(String, u64)>, token: &str| {
                    model.iter().any(|(of, _)| of == token)
                };
                match what {
                    0 => {
                        let was_there = is_there(&model, &token);
                        if !is_closed(&closed) {
                            model.insert((token.clone(), router));
                        }
                        let is_new = is_there(&model, &token) && !was_there;
                        prop_assert_eq!(tokens.add(&token, router), is_new);
                    }
                    1 => {
                        let was_there = is_there(&model, &token);
                        model.remove(&(token.clone(), router));
                        let went = was_there && !is_there(&model, &token);
                        prop_assert_eq!(tokens.remove(&token, router), went);
                    }
                    _ => {
                        let before: HashSet<String> = model.iter().map(|(of, _)| of.clone()).collect();
                        model.retain(|(_, on)| *on != router);
                        closed.insert(router);
                        let went = before.into_iter().filter(|token| !is_there(&model, token));
                        let went: HashSet<String> = went.collect();
                        let reported: HashSet<String> = tokens.router_closed(router).into_iter().collect();
                        prop_assert_eq!(reported, went);
                    }
                }
            }
        }
    }
}

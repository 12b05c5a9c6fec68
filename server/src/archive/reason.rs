//! Why a request to the storage of a bucket failed, in a sentence.
//!
//! The texts of `object_store` contain whole answers of the storage, which may be long and may repeat
//! parts of the request with its credentials.

use std::error::Error;

/// Maximum length of a reason, characters.
const REASON_MAX: usize = 300;
/// Address at which machines of clouds ask for the credentials of their role.
const METADATA_ADDRESS: &str = "169.254.169.254";

/// Returns the reason of a failure.
pub(super) fn reason(failure: &object_store::Error) -> String {
    let whole = failure.to_string();
    if whole.contains(METADATA_ADDRESS) {
        return "AWS_ACCESS_KEY_ID is not set, and this machine has no role that gives credentials"
            .to_owned();
    }
    let status = whole
        .split_once("status code: ")
        .map(|(_, rest)| rest.split(':').next().unwrap_or(rest));
    let answer = Answer(&whole);
    let code = answer.element("Code");
    let answer = code.map(|code| match answer.element("Message") {
        Some(message) => format!("{code}: {message}"),
        None => code.to_owned(),
    });
    let reason = match (answer, status) {
        (Some(answer), _) => answer,
        (None, Some(status)) => format!("the storage answers with {status}"),
        (None, None) => deepest(failure),
    };
    shortened(&reason)
}

/// Answer of the storage, in XML.
#[derive(Clone, Copy)]
struct Answer<'text>(&'text str);

impl<'text> Answer<'text> {
    /// Returns the content of an element.
    fn element(self, name: &str) -> Option<&'text str> {
        let (_, rest) = self.0.split_once(&format!("<{name}>"))?;
        let (content, _) = rest.split_once(&format!("</{name}>"))?;
        Some(content)
    }
}

/// Returns the text of the first cause, which is the most exact one.
fn deepest(failure: &object_store::Error) -> String {
    let mut found: &dyn Error = failure;
    while let Some(source) = found.source() {
        found = source;
    }
    found.to_string()
}

fn shortened(text: &str) -> String {
    let printable = text.chars().map(|c| if c.is_control() { ' ' } else { c });
    let mut shortened: String = printable.take(REASON_MAX + 1).collect();
    if shortened.chars().count() > REASON_MAX {
        shortened.pop();
        shortened.push('…');
    }
    shortened
}

#[cfg(test)]
mod tests {
    use super::*;

    fn failure(text: &str) -> object_store::Error {
        object_store::Error::Generic {
            store: "S3",
            source: text.to_owned().into(),
        }
    }

    #[test]
    fn an_answer_is_its_code_and_message_and_nothing_of_the_request() {
        let secret = "x-amz-security-token:FwoGZXIvYXdzE";
        let text = format!(
            "Server returned non-2xx status code: 403 Forbidden: <?xml?><Error><Code>SignatureDoesNotMatch\
             </Code><Message>The signature differs</Message><CanonicalRequest>{secret}\
             </CanonicalRequest></Error>"
        );
        assert_eq!(
            reason(&failure(&text)),
            "SignatureDoesNotMatch: The signature differs"
        );
        let text = format!("status code: 502 Bad Gateway: <html>{secret}</html>");
        assert_eq!(
            reason(&failure(&text)),
            "the storage answers with 502 Bad Gateway"
        );
        let long = reason(&failure(&"ä\n".repeat(1_000)));
        assert_eq!(long.chars().count(), REASON_MAX + 1);
        assert!(!long.contains('\n'));
    }

    #[test]
    fn missing_credentials_are_named() {
        let text = "GET http://169.254.169.254/latest/api/token failed";
        assert!(reason(&failure(text)).starts_with("AWS_ACCESS_KEY_ID is not set"));
    }
}

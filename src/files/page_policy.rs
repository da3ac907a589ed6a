//! Content security policies of the HTML pages this program writes. With such a policy the browser runs only scripts
//! whose digests are listed and makes no network requests, whatever text from an input file the page contains.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use sha2::{Digest, Sha256};

/// Returns the digest by which a content security policy allows one inline script or style, such as `'sha256-…'` (with
/// the quotes). `content` is the text between the tags of the script or style.
pub fn policy_digest(content: &str) -> String {
    format!("'sha256-{}'", STANDARD.encode(Sha256::digest(content)))
}

/// Returns the `<meta>` element of an HTML page with a content security policy that forbids everything except
/// `directives`. Each directive is a pair of a name, such as `img-src`, and the sources that it allows, such as
/// `data:`.
pub fn policy_meta_element(directives: &[(&str, &[String])]) -> String {
    let mut content = "default-src 'none'; base-uri 'none'; form-action 'none'".to_owned();
    for (name, sources) in directives.iter().filter(|(_, sources)| !sources.is_empty()) {
        content += &format!("; {name} {}", sources.join(" "));
    }
    format!("<meta http-equiv=\"Content-Security-Policy\" content=\"{content}\">")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn digest_matches_the_specification() {
        // Example from "Content Security Policy Level 3", section 8.3.
        assert_eq!(policy_digest("doSomething();"), "'sha256-RFWPLDbv2BY+rCkDzsE+0fr8ylGr2R2faWMhq4lfEQc='");
    }

    #[test]
    fn a_policy_allows_nothing_else() {
        let policy = policy_meta_element(&[("script-src", &[]), ("img-src", &["data:".to_owned()])]);
        let content = "default-src 'none'; base-uri 'none'; form-action 'none'; img-src data:";
        assert_eq!(policy, format!("<meta http-equiv=\"Content-Security-Policy\" content=\"{content}\">"));
    }
}

#!/bin/sh
# Makes scripts/report_image.png, an image of the README: the slider of a report on a strongly compressed model.
#
#     cargo build --release
#     scripts/report_image.sh target/release/splatsieve DATA/room2_dynerf scripts/report_image.png
#
# DATA/<name> is a model folder with its cameras in it. Needs Chromium (apt-get install chromium-headless-shell),
# or another one named in SPLATSIEVE_BROWSER.
set -eu
if [ $# -ne 3 ]; then
    sed -n '2,8s/^# \{0,1\}//p' "$0" >&2
    exit 2
fi
splatsieve=$1 model=$2 image=$3
browser=${SPLATSIEVE_BROWSER:-chromium-headless-shell}
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT

"$splatsieve" compress "$model" --cameras "$model" --preset strong -o "$folder/small"
"$splatsieve" report "$model" "$folder/small" --cameras "$model" --max-frames 3 -o "$folder/report"
# The slider alone.
only='header, section:not(#compare), h2, .slider + .slider, .note { display: none } main { padding: 14px 20px }'
sed "s|</head>|<style>$only</style></head>|" "$folder/report/report.html" >"$folder/slider.html"
"$browser" --headless --no-sandbox --disable-gpu --hide-scrollbars --window-size=620,665 \
    --screenshot="$folder/report.png" "file://$folder/slider.html" 2>/dev/null
mkdir -p "$(dirname "$image")"
mv "$folder/report.png" "$image"

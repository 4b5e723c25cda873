#!/bin/sh
# A stand-in for python:3.11-slim, made of Debian's packages: for building the image where no registry can be reached,
# but a mirror of Debian can. It needs root, mmdebstrap, and podman or docker:
#     tools/image_base.sh && make image BASE=localhost/python:3.11-slim
# It is Debian 12 with Python 3.11 and its headers. For production take a base that is pinned by digest.
set -eu
engine=${ENGINE:-$(command -v podman || command -v docker)}
name=${1:-localhost/python:3.11-slim}
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
mmdebstrap --quiet --variant=minbase \
  --include=python3,python3-venv,libpython3-dev,ca-certificates,netbase,tzdata \
  --dpkgopt='path-exclude=/usr/share/doc/*' --dpkgopt='path-exclude=/usr/share/man/*' \
  --customize-hook='ln -s python3 "$1/usr/bin/python"' \
  bookworm "$folder/base.tar"
"$engine" import --change 'CMD ["python"]' "$folder/base.tar" "$name"

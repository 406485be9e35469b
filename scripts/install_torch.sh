#!/usr/bin/env bash
# Install the CPU build of PyTorch, never the multi-gigabyte CUDA one unless asked to.
# usage: install_torch.sh PYTHON        (ALLOW_CUDA=1 takes what the default index offers)
set -euo pipefail
python=$1
version=2.13.0

# "+cpu" exists on PyTorch's own index only, so a default index can never give the wrong build
if "$python" -m pip install -q --retries 1 --timeout 20 \
    --extra-index-url https://download.pytorch.org/whl/cpu "torch==$version+cpu"; then
  exit 0
fi
echo "install_torch: no torch $version+cpu from PyTorch's index; looking at the default index" >&2
plan=$("$python" -m pip install --dry-run "torch==$version" | grep '^Would install' || true)
if [[ $plan == *nvidia* && -z ${ALLOW_CUDA:-} ]]; then
  echo "install_torch: the default index offers only the CUDA build (several GB)." >&2
  echo "Install a CPU build of torch into the environment yourself, or set ALLOW_CUDA=1." >&2
  exit 1
fi
exec "$python" -m pip install -q "torch==$version"

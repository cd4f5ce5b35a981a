# A simulated fish and its page, for computers where fishd does not run itself:
#   docker build -t fishd . && docker run --rm -p 127.0.0.1:8880:8880 fishd
ARG BASE=python:3.13-slim
FROM ${BASE} AS build
WORKDIR /src
COPY . .
# The version of a release; the history of git is not part of the image.
ARG VERSION=
ENV SETUPTOOLS_SCM_PRETEND_VERSION_FOR_FISHD=${VERSION}
RUN sed -nE 's/^([^ #]+==[^ ]+).*/\1/p' tools/locks/python3.13.txt >versions.txt \
 && python3 -m venv /opt/fishd \
 && /opt/fishd/bin/pip install --no-cache-dir --constraint versions.txt '.[lab,policy,window]'

FROM ${BASE}
COPY --from=build /opt/fishd /opt/fishd
COPY tools/container.sh /usr/local/bin/fish-and-page
ENV PATH=/opt/fishd/bin:$PATH
RUN useradd --create-home fish
USER fish
WORKDIR /home/fish
EXPOSE 8880
HEALTHCHECK --interval=10s --timeout=5s --start-period=30s CMD ["fishctl", "status"]
CMD ["fish-and-page"]
